"""What is fast and how fast: `python -m benchmarks.NAME` prints medians and ratios of one run."""
