"""Commands that measure speed, endurance, accuracy, and the information in tactile data.

`python -m benchmarks.NAME --help` describes the command NAME.
"""
