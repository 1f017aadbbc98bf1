"""Warnings are errors, shapes and types are checked while tests run."""

import atexit
import os
import shutil
import tempfile

os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("MPLBACKEND", "agg")
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # see sts_jax.compilation
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:  # one for all workers: what one has compiled, the other reads
    os.environ["JAX_COMPILATION_CACHE_DIR"] = tempfile.mkdtemp(prefix="sts_jax_tests_")
    atexit.register(shutil.rmtree, os.environ["JAX_COMPILATION_CACHE_DIR"], ignore_errors=True)

import jax
import jaxtyping
import pytest

jaxtyping.install_import_hook("sts_jax", "checker.check")


@pytest.fixture(autouse=True, scope="module")
def release_compiled_programs():
    """Each compiled program holds memory maps; all of the tests' in one process pass Linux's limit of 65,530, and XLA
    then dies of a segmentation fault."""
    yield
    jax.clear_caches()
