"""Set-up of the tests: run-time checks of shapes and types, and faster compilation.

Most of the suite's time is compilation. Four settings shorten it:

- All worker processes share one cache of compiled programs, including small ones. If JAX_COMPILATION_CACHE_DIR is set,
  the cache is kept there.
- XLA optimises less, which shortens compilation by a third. The small arrays of the tests do not need more. At level 0
  it would take another quarter less, but without the fusion emitters it then draws wrong images (jaxlib 0.10.1). A
  variable XLA_FLAGS in the environment takes precedence, even if it is empty. The notebooks are tested with XLA's
  defaults.
- Python collects garbage less often, because each search visits the millions of objects that JAX keeps.
- Compiled programs stay in memory from one test file to the next, as long as there is room for them.
"""

import atexit
import ctypes
import gc
import importlib.metadata
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("MPLBACKEND", "agg")
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # see sts_jax.compilation
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
# Otherwise the folder is in the key of each program, and after `enable_compilation_cache`, which commands call, a
# process would find none of the programs of the others.
os.environ.setdefault("JAX_PERSISTENT_CACHE_ENABLE_XLA_CACHES", "none")
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    os.environ["JAX_COMPILATION_CACHE_DIR"] = tempfile.mkdtemp(prefix="sts_jax_tests_")
    atexit.register(shutil.rmtree, os.environ["JAX_COMPILATION_CACHE_DIR"], ignore_errors=True)
# XLA aborts on an unknown flag. The golden files were written with XLA's defaults.
if importlib.metadata.version("jaxlib").startswith("0.10.") and "STS_JAX_EXACT" not in os.environ:
    os.environ.setdefault(
        "XLA_FLAGS",
        "--xla_backend_optimization_level=1 --xla_llvm_disable_expensive_passes=true "
        "--xla_cpu_use_fusion_emitters=false",
    )

import jax
import jaxtyping
import pytest

gc.set_threshold(200_000, 20, 100)
jaxtyping.install_import_hook("sts_jax", "checker.check")

MOST_MAPS = 30_000  # memory maps of a process. Linux allows 65,530, and XLA crashes beyond that
MOST_PAGES = 500_000  # pages of 4 kB of a process, 2 GB. Otherwise each process grows to 8 GB


@pytest.fixture
def strict_ranks():
    """Arrays of different ranks are not broadcast against each other without a word."""
    with jax.numpy_rank_promotion("raise"):
        yield


@pytest.fixture(autouse=True, scope="module")
def release_compiled_programs():
    """Drop all compiled programs before they take too many memory maps or too much memory."""
    yield
    maps, pages = Path("/proc/self/maps"), Path("/proc/self/statm")
    few = maps.exists() and maps.read_bytes().count(b"\n") <= MOST_MAPS
    if few and int(pages.read_text().split()[1]) <= MOST_PAGES:
        return
    jax.clear_caches()
    gc.collect()
    if trim := getattr(ctypes.CDLL(None), "malloc_trim", None):  # glibc keeps the memory otherwise
        trim(0)


@pytest.fixture
def small_disk(tmp_path):
    """A file system of 300 kB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=300k", "tmpfs", str(folder)]
    if not sys.platform.startswith("linux") or os.geteuid() != 0 or subprocess.run(command, check=False).returncode:
        pytest.skip("mounting a small file system needs root")
    yield folder
    subprocess.run(["umount", "-l", str(folder)], check=True)
