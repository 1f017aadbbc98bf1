"""The paper's experiments and further commands. Run one with `python -m experiments.NAME`."""

import os

# jaxlib reads this variable when it is imported, see `sts_jax.compilation`.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
