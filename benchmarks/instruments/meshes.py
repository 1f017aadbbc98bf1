"""Public meshes that come with the test dependencies."""

import importlib.util
from pathlib import Path


def public_meshes() -> Path:
    """The folder of miniworld's meshes (Farama Foundation, Apache 2.0).

    Its code is not imported, because that needs a display.

    Raises:
        ModuleNotFoundError: miniworld is not installed.
    """
    found = importlib.util.find_spec("miniworld")
    if found is None or found.origin is None:
        raise ModuleNotFoundError("the meshes come with miniworld. Install it: pip install -e '.[test]'")
    return Path(found.origin).parent / "meshes"
