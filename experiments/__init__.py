"""The experiments of the paper and further commands, run by `python -m experiments.NAME`. `shared` has common parts."""

import os

# jaxlib reads this as it is imported, see `sts_jax.compilation`.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
