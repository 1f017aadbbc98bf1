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
    """Let JAX keep compiled programs on disk, so that the next session loads them instead of compiling them again.

    Call this function once, before the first computation. It changes JAX's settings for the whole process. The commands
    in `experiments` call it. The library itself never calls it.

    On a CPU, XLA logs an error about processor features for each program that it loads from the cache. This message is
    harmless. XLA stores two of its own tuning options with the program as if these were features of a processor, but no
    processor has such features (JAX issue 38445). Set the environment variable TF_CPP_MIN_LOG_LEVEL=3 before
    `import jax` to hide the message.

    Args:
        folder: Folder of the cache. None selects the folder in the environment variable JAX_COMPILATION_CACHE_DIR. If
            that variable is set to an empty string, nothing is cached. If the variable is not set, the cache is a
            folder in `$XDG_CACHE_HOME/sts_jax`, by default in `~/.cache/sts_jax`. Each kind of processor has its own
            folder there, because a program that was compiled for one kind may not run on another.

    Returns:
        The folder of the cache. The result is None if `folder` is None and JAX_COMPILATION_CACHE_DIR is set to an empty
        string.

    Raises:
        OSError: The folder cannot be created.
        ValueError: `folder` is an empty string.
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
