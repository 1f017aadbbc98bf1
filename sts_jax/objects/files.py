"""Images and other files to which a mesh file refers. Only regular files are opened."""

import io
import os
import warnings
from pathlib import Path

import numpy as np
from PIL import Image

ENCODINGS = ("cp1252", "gbk", "shift_jis", "big5", "euc_kr", "cp1251")  # of names that are not UTF-8
LARGE = 2048  # pixels, images of at least twice this side are reduced while they are read


class Refusal(ValueError):
    """A fault of a file, with its remedy."""


class Files:
    """Finds the files to which a mesh file refers, in its folder or in a folder of images.

    If `plain`, materials and images are not looked up.
    """

    def __init__(self, path: Path, images: Path | None = None, plain: bool = False) -> None:
        self.path, self.images, self.plain = path, images, plain
        self.found: dict[str, Path | None] = {}  # the path of each name, or None if the file is missing
        self.problems: list[str] = []  # what the mesh lacks, besides missing files

    def find(self, name: bytes | str, *alternatives: bytes | str) -> Path | None:
        """Find a file by its relative path or by its base name, whatever the encoding of its name."""
        place = next((place for text in (name, *alternatives) if (place := self.place(text)) is not None), None)
        self.found[name if isinstance(name, str) else name.decode(errors="replace")] = place
        return place

    def place(self, name: bytes | str) -> Path | None:
        """Return the path of a file, or None if it is missing, without a record."""
        raw = name.encode(errors="surrogateescape") if isinstance(name, str) else name
        for spelling in (os.fsdecode(raw), *(raw.decode(encoding, "replace") for encoding in ENCODINGS)):
            relative = spelling.strip().strip('"').replace("\\", "/")
            base = os.path.basename(relative)
            for folder in (self.path.parent, self.images):
                for place in () if folder is None else (folder / relative, folder / base):
                    if os.path.isfile(place):
                        return place
        return None

    def image(self, name: bytes | str) -> Image.Image | None:
        """Read an image, or return None if it is missing."""
        path = self.find(name)
        return None if path is None else read_image(path)

    def get(self, name: str) -> bytes:
        """Return the content of a file for trimesh."""
        path = None if self.plain else self.find(name)
        if path is None:
            raise FileNotFoundError(name)
        return path.read_bytes()

    __getitem__ = get

    def report(self, strict: bool) -> None:
        """Warn of missing files and other problems, or raise an error if `strict`."""
        missing = ", ".join(str(self.path.parent / name) for name, file in self.found.items() if file is None)
        if missing:
            text = f"the mesh refers to missing files: {missing}. Add them, or give an image (argument texture)"
            if strict:
                raise FileNotFoundError(f"{self.path}: {text}")
            self.problems.insert(0, text)
        if self.problems and strict:
            raise Refusal("; ".join(self.problems))
        if self.problems:
            warnings.warn(f"{self.path}: {'; '.join(self.problems)}", stacklevel=4)


def read_image(source: Path | bytes, name: str = "") -> Image.Image:
    """Read an image file, or its content, as RGB with 8 bits. A large image is reduced."""
    name = name or str(source)
    if isinstance(source, Path) and not source.is_file():
        raise FileNotFoundError(f"{name}: no such image file: check the path")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of large images
            with Image.open(io.BytesIO(source) if isinstance(source, bytes) else source) as opened:
                opened.draft("RGB", (LARGE, LARGE))
                opened.load()
                picture = rgb(opened)
    except Image.DecompressionBombError as error:
        limit = 2 * (Image.MAX_IMAGE_PIXELS or 0)
        raise Refusal(f"{name}: the image has more than {limit:,} pixels: reduce it to 1,024 x 1,024") from error
    except (OSError, SyntaxError, ValueError, EOFError, MemoryError) as error:
        raise Refusal(f"{name}: the file cannot be read as an image ({error}): replace the file") from error
    factor = max(1, picture.width // LARGE), max(1, picture.height // LARGE)
    return picture if factor == (1, 1) else picture.reduce(factor)


def rgb(picture: Image.Image) -> Image.Image:
    """Convert an image to RGB with 8 bits. Grey values of 16 bits, which Pillow clips, and floats are scaled."""
    if picture.mode[0] not in "IF":
        return picture if picture.mode == "RGB" else picture.convert("RGB")
    values = np.asarray(picture, float)
    full = 1.0 if picture.mode == "F" else 65535.0
    if not (np.isfinite(values).all() and 0 <= values.min() <= values.max() <= full):
        raise ValueError(f"its values are from {values.min():g} to {values.max():g}, not from 0 to {full:g}")
    return Image.fromarray(np.rint(values * (255 / full)).astype(np.uint8)).convert("RGB")
