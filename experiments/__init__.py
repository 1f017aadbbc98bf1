"""The paper's experiments and further commands. Run one with `python -m experiments.NAME`."""

import os
import sys

# jaxlib reads this variable when it is imported, see `sts_jax.compilation`.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

if sys.argv[0] == "-m":  # Python looks for the command, and has not imported it yet
    from experiments.shared import interrupts

    interrupts.end_at_once()
    # Without this, importing MuJoCo starts a process that looks for GLFW and prints a traceback at Ctrl-C.
    os.environ.setdefault("MUJOCO_GL", "disable")
