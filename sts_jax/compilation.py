"""Storage of compiled programs on disk, for later sessions."""

import hashlib
import math
import os
import platform
import tempfile
import warnings
from pathlib import Path
from typing import Any

import jax

_ROOM = 2**20  # bytes that a usable folder must have room for


def cache_folder() -> Path:
    """Folder for files that can be recreated: `$XDG_CACHE_HOME/sts_jax`, by default `~/.cache/sts_jax`."""
    folder = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    # A user without a home, as in a container, has a `~`. Nothing can be written below os.devnull.
    return Path(os.devnull if folder.startswith("~") else folder) / "sts_jax"


def enable_compilation_cache(folder: str | os.PathLike[str] | None = None) -> Path | None:
    """Let JAX keep compiled programs on disk, so that the next session loads them.

    Call this function once, before the first computation. It changes JAX's settings for the whole process. The commands
    in `experiments` call it; the library itself never does. If the folder cannot be written, a warning says so, and
    programs are not kept. On a CPU, XLA logs a harmless error about processor features for each program that it loads
    (JAX issue 38445). This function therefore lets XLA log only fatal errors, unless TF_CPP_MIN_LOG_LEVEL or
    `jax_logging_level` is set.

    Args:
        folder: Folder of the cache. None selects JAX_COMPILATION_CACHE_DIR, or, if that variable is not set,
            `$XDG_CACHE_HOME/sts_jax` (default `~/.cache/sts_jax`). It has a folder for each kind of processor, because
            a program that was compiled for one kind may not run on another.

    Returns:
        The folder for this kind of processor. None if nothing is cached: JAX_COMPILATION_CACHE_DIR is empty, or the
        folder cannot be created.
    """
    if folder is None and "JAX_COMPILATION_CACHE_DIR" in os.environ:
        folder = os.environ["JAX_COMPILATION_CACHE_DIR"]
        if not folder:
            return None
    if folder is not None and not os.fspath(folder):
        raise ValueError(
            "the argument `folder` is an empty string: give a path, such as '.' for the current directory."
        )
    path = (cache_folder() if folder is None else Path(folder)) / processor()
    problem = _problem(path)
    if problem is not None:
        warnings.warn(
            f"compiled programs are not kept, because {path} cannot be written ({problem}): set "
            "JAX_COMPILATION_CACHE_DIR to another folder.",
            stacklevel=2,
        )
    kept = path if path.is_dir() else None
    jax.config.update("jax_compilation_cache_dir", kept and str(kept))
    # By default JAX keeps only programs that took a second to compile, but a session runs hundreds of smaller ones.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0 if problem is None else math.inf)
    config: Any = jax.config
    # JAX sets the variable to 1 if it is not set.
    if os.environ.get("TF_CPP_MIN_LOG_LEVEL", "1") == "1" and config.jax_logging_level in (None, "NOTSET"):
        jax.config.update("jax_logging_level", "CRITICAL")  # of XLA and of JAX
        jax.config.update("jax_logging_level", "NOTSET")  # of JAX alone
    return kept


def _problem(folder: Path) -> str | None:
    """Create a folder. Return why it cannot be written, or None."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(bytes(_ROOM))
    except OSError as error:
        return error.strerror or str(error)
    return None


def processor() -> str:
    """Short hash of the kind of processor. Machines with the same hash can share compiled programs."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    features = sorted({line for line in lines if line.startswith(("model name", "flags", "Features", "CPU part"))})
    return hashlib.sha256("\n".join([platform.machine(), platform.processor(), *features]).encode()).hexdigest()[:12]
