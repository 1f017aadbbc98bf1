"""The paper's experiments: one short file each, run by `python -m experiments.NAME`."""

import os

# jaxlib reads this as it is imported, see `sts_jax.compilation`.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
