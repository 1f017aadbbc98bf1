"""Where things are kept between runs, among them what JAX compiles."""

import hashlib
import os
import platform
from pathlib import Path

import jax


def cache_folder() -> Path:
    """For what can be made again: `sts_jax` in XDG_CACHE_HOME, or in ~/.cache where that is not set or empty."""
    return Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "sts_jax"


def keep() -> None:
    """Let JAX keep compiled programs in a folder: JAX_COMPILATION_CACHE_DIR, or one in `cache_folder`.

    There is one for each kind of processor, since what was compiled for another may not run. For entry points only:
    the library leaves JAX's settings alone. An empty JAX_COMPILATION_CACHE_DIR keeps nothing.

    On a CPU, XLA logs an error for each program that it takes from there: preferences of its own, not to gather and
    not to scatter, are no features of any processor (jax#38445). `experiments/__init__.py` silences its log; what fails
    is an exception all the same.
    """
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        jax.config.update("jax_compilation_cache_dir", str(cache_folder() / processor()))


def processor() -> str:
    """A name for the kind of processor, the same wherever the same programs run."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    told = sorted({line for line in lines if line.startswith(("model name", "flags", "Features", "CPU part"))})
    return hashlib.sha256("\n".join([platform.machine(), platform.processor(), *told]).encode()).hexdigest()[:12]
