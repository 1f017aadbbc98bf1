"""Storage of compiled programs on disk, for later sessions."""

import hashlib
import os
import platform
from pathlib import Path

import jax


def cache_folder() -> Path:
    """Folder for files that can be recreated: `$XDG_CACHE_HOME/sts_jax`, by default `~/.cache/sts_jax`."""
    return Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "sts_jax"


def enable_compilation_cache(folder: str | os.PathLike[str] | None = None) -> Path | None:
    """Let JAX keep compiled programs on disk, so that the next session loads them.

    Call this function once, before the first computation. It changes JAX's settings for the whole process. The commands
    in `experiments` call it; the library itself never does. On a CPU, XLA logs a harmless error about processor
    features for each program that it loads (JAX issue 38445): set TF_CPP_MIN_LOG_LEVEL=3 before `import jax` to hide
    it.

    Args:
        folder: Folder of the cache. None selects JAX_COMPILATION_CACHE_DIR, or, if that variable is not set, a folder
            for this kind of processor in `$XDG_CACHE_HOME/sts_jax` (default `~/.cache/sts_jax`), because a program that
            was compiled for one kind may not run on another.

    Returns:
        The folder, or None if `folder` is None and JAX_COMPILATION_CACHE_DIR is empty: nothing is cached then.
    """
    if folder is None and "JAX_COMPILATION_CACHE_DIR" in os.environ:
        folder = os.environ["JAX_COMPILATION_CACHE_DIR"]
        if not folder:
            return None
    if folder is not None and not os.fspath(folder):
        raise ValueError(
            "the argument `folder` is an empty string: give a path, such as '.' for the current directory."
        )
    path = cache_folder() / processor() if folder is None else Path(folder)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise type(error)(
            f"folder {path} cannot be created ({error.strerror}): give another folder for the cache."
        ) from error
    jax.config.update("jax_compilation_cache_dir", str(path))
    # By default JAX keeps only programs that took a second to compile, but a session runs hundreds of smaller ones.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
    return path


def processor() -> str:
    """Short hash of the kind of processor. Machines with the same hash can share compiled programs."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    features = sorted({line for line in lines if line.startswith(("model name", "flags", "Features", "CPU part"))})
    return hashlib.sha256("\n".join([platform.machine(), platform.processor(), *features]).encode()).hexdigest()[:12]
