"""Checks of output paths before any work is done."""

import tempfile
from pathlib import Path

PICTURES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".pdf")  # formats that Pillow and Matplotlib write


def check_picture(path: Path) -> None:
    """Raise an error unless a picture can be written.

    Raises:
        OSError: Its folder does not exist or is not writable, or the path is a folder.
        ValueError: The suffix is not that of a known format.
    """
    if path.is_dir():
        raise IsADirectoryError(f"{path} is a folder: give the name of a picture, such as {path / 'picture.png'}")
    if path.suffix.lower() not in PICTURES:
        raise ValueError(f"{path} has the suffix {path.suffix!r}, but it must be one of {', '.join(PICTURES)}")
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{path.parent} does not exist: make it for {path.name}, or give another --out")
    _write(path.parent)
    if path.exists():
        try:
            path.open("ab").close()
        except OSError as error:
            raise type(error)(f"{path} cannot be overwritten ({error.strerror}): give another --out") from error


def make_folder(path: Path) -> None:
    """Make a folder if it does not exist, and check that it can be written to.

    Raises:
        OSError: The folder cannot be made or written to.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise type(error)(f"{path} cannot be made ({error.strerror}): give another --out") from error
    _write(path)


def _write(folder: Path) -> None:
    try:
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise type(error)(f"{folder} cannot be written to ({error.strerror}): give another --out") from error
