"""Public meshes that come with the test dependencies."""

import importlib.util
from pathlib import Path


def public_meshes() -> Path:
    """Find the folder of the meshes of the package miniworld (Farama Foundation, Apache 2.0).

    The package is not imported, because its code needs a display.

    Raises:
        ModuleNotFoundError: miniworld is not installed.
    """
    found = importlib.util.find_spec("miniworld")
    if found is None or found.origin is None:
        raise ModuleNotFoundError(
            "the test meshes are in the package miniworld, which is missing: pip install -e '.[test]'"
        )
    return Path(found.origin).parent / "meshes"
