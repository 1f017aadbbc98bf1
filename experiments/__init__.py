"""The paper's experiments: one short file each, run by `python -m experiments.NAME`."""
