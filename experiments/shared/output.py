"""Checks output paths before a command starts its work, and writes pictures atomically."""

import io
import tempfile
from pathlib import Path

from matplotlib.figure import Figure
from PIL import Image

from sts_jax import storage

PICTURES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".pdf")  # formats that Pillow and Matplotlib write


def check_picture(path: Path) -> None:
    """Check that a picture can be written to a path.

    Raises:
        OSError: The folder of the picture does not exist or cannot be written to, the existing picture cannot be
            overwritten, or the path is a folder.
        ValueError: The suffix is not one of `PICTURES`.
    """
    if path.is_dir():
        raise IsADirectoryError(f"{path} is a folder: give the name of a picture, such as {path / 'picture.png'}")
    if path.suffix.lower() not in PICTURES:
        raise ValueError(f"{path} has the suffix {path.suffix!r}, but it must be one of {', '.join(PICTURES)}")
    if not path.parent.is_dir():
        raise FileNotFoundError(
            f"the folder {path.parent} of {path.name} does not exist: make this folder, or give another path"
        )
    _write(path.parent)
    if path.exists():
        try:
            path.open("ab").close()
        except OSError as error:
            raise type(error)(f"{path} cannot be overwritten ({error.strerror}): give another path") from error


def make_folder(path: Path) -> None:
    """Make a folder if it does not exist, and check that it can be written to.

    Raises:
        OSError: The folder cannot be made or written to.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise type(error)(f"the folder {path} cannot be made ({error.strerror}): give another path") from error
    _write(path)


def _write(folder: Path) -> None:
    """Raise an error if no file can be written to a folder."""
    try:
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise type(error)(f"the folder {folder} cannot be written to ({error.strerror}): give another path") from error


def write_picture(path: Path, picture: Image.Image) -> None:
    """Write a picture atomically, in the format that belongs to the suffix of the path.

    Args:
        path: The file. Its suffix must be one of `PICTURES`.
        picture: The picture.

    Raises:
        OSError: The file cannot be written. The message names the file and the remedy.
    """
    buffer = io.BytesIO()
    picture.save(buffer, Image.registered_extensions()[path.suffix.lower()])
    storage.write_bytes(path, buffer.getvalue())


def write_figure(path: Path, figure: Figure, *, dpi: float) -> None:
    """Write a figure atomically, in the format that belongs to the suffix of the path.

    Args:
        path: The file. If it has no suffix, the format is PNG.
        figure: The figure.
        dpi: Resolution (pixels per inch).

    Raises:
        ValueError: Matplotlib does not know the format.
        OSError: The file cannot be written. The message names the file and the remedy.
    """
    buffer = io.BytesIO()
    figure.savefig(buffer, format=path.suffix[1:] or "png", dpi=dpi)
    storage.write_bytes(path, buffer.getvalue())
