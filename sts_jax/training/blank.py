"""Write and read the file `blank.npz` in a model's folder. It contains the images of the sensor without an object."""

import io
from pathlib import Path

import numpy as np

from sts_jax import storage
from sts_jax.training import manifest


def save_blank(folder: Path, visual: np.ndarray, tactile: np.ndarray) -> None:
    """Write the images of the empty sensor to `folder/blank.npz`. An existing file is not changed.

    Args:
        folder: Folder of the model.
        visual: Visual image, uint8 `(height, width, 3)`.
        tactile: Tactile image, uint8 `(height, width, 3)`.

    Raises:
        OSError: The file cannot be written, or `manifest.json`, which has the checksums of the model's files, is
            damaged.
    """
    path = folder / "blank.npz"
    new = not path.exists()
    if new:
        storage.write_arrays(path, {"visual": visual, "tactile": tactile})
    listed = manifest.read(folder)
    if listed is not None and (new or path.name not in listed.files):
        manifest.add(folder, path.name)


def load_blank(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read the images of the empty sensor from `folder/blank.npz`.

    Args:
        folder: Folder of the model.

    Returns:
        The visual and the tactile image, uint8 `(height, width, 3)`.

    Raises:
        FileNotFoundError: The file is missing.
        OSError: The file cannot be read, for example because the permission is missing.
        DamagedFileError: The file is damaged.
    """
    path = folder / "blank.npz"
    if not path.exists():
        raise FileNotFoundError(
            f"{path} is missing: start the training again, or write the file with training.save_blank."
        )
    content = path.read_bytes()
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
            images = arrays["visual"], arrays["tactile"]
        if any(image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 for image in images):
            found = ", ".join(f"{image.dtype} {image.shape}" for image in images)
            raise ValueError(f"the images are {found}, but they must be uint8 (height, width, 3)")
    except Exception as error:  # zipfile, zlib and NumPy raise many types for damaged archives
        raise storage.DamagedFileError(
            f"{path} is damaged ({type(error).__name__}: {error}): delete it and start the training again, which "
            "writes the file anew."
        ) from error
    return images
