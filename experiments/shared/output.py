"""Checks output paths before a command starts its work."""

import tempfile
from pathlib import Path

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
