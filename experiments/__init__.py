"""The paper's experiments and further commands. Run one with `python -m experiments.NAME`."""

import os
import sys

# jaxlib reads this variable when it is imported, see `sts_jax.compilation`.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

if sys.argv[0] == "-m":  # Python looks for the command, and has not imported it yet
    if sys.platform == "linux" and "GLIBC_TUNABLES" not in os.environ:
        # XLA allocates the memory of a program anew at each call, up to a gigabyte, and Linux clears it page by page.
        # Large pages save a quarter of the time of a training step of the paper's model. The C library reads the
        # variable only when a process starts.
        os.environ["GLIBC_TUNABLES"] = "glibc.malloc.hugetlb=1"
        os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])
    from experiments.shared import interrupts

    interrupts.end_at_once()
    # Without this, importing MuJoCo starts a process that looks for GLFW and prints a traceback at Ctrl-C.
    os.environ.setdefault("MUJOCO_GL", "disable")
