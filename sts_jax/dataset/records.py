"""Reading and writing of shards, the files of a dataset.

A file is written as a whole or not at all, and the same inputs give the same bytes.

A shard is a pair of files with the data of some objects. `NAME.array_record` has one record per rendered frame: the
visual image, the tactile image (`uint8`, `(height, width, 3)`) and the segmentation (bits), in that order. The frames
are followed by one record per view. A view is a visual image of an object in an initial pose from which no trajectory
is simulated.

`NAME.npz` contains the `Identity` of the shard, the SHA-256 of `NAME.array_record`, and all other data as named arrays.
The identity and the SHA-256 show a reader whether one of the two files comes from another shard or dataset. `NAME.npz`
is written last, and a shard without `NAME.npz` counts as missing.
"""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from array_record.python.array_record_module import ArrayRecordReader, ArrayRecordWriter

from sts_jax import physics
from sts_jax.storage import DamagedFileError, read_arrays, sha256, write_arrays, write_whole

FORMAT = 4  # format of a dataset's files, incremented when older files can no longer be read
ARRAYS = {  # names of the arrays in a shard's .npz, apart from its identity
    *(f"trajectory/{name}" for name in physics.Trajectory._fields if name != "hidden"),
    *(f"hidden/{name}" for name in physics.Hidden._fields),
    *(f"solid/{name}" for name in ("support", "mirrored", "mass", "com")),
    *(f"view/{name}" for name in ("pose", "body", "support", "mass", "com")),
    "frames",
    "left_out",
}
# One record per group, because a read decompresses the whole group.
WRITER_OPTIONS = "group_size:1,zstd:3"


class Images(NamedTuple):
    """The visual images, tactile images and segmentations of n rendered frames, as a dataset stores them."""

    visual: np.ndarray  # uint8 (n, height, width, 3)
    tactile: np.ndarray  # uint8 (n, height, width, 3)
    segmentation: np.ndarray  # bool (n, height, width)


class Identity(NamedTuple):
    """Identity of a shard: its dataset, sensor and index. A shard is a pair of files with the data of some objects."""

    collection: str  # SHA-256 of the content of collection.json
    sensor: str  # SHA-256 of the content of sensor.json
    shard: int  # index of the shard


def shard_path(folder: Path, count: int, index: int) -> Path:
    """Path of the `.array_record` file with the images of a shard.

    Args:
        folder: The folder of the dataset.
        count: Number of shards in the dataset.
        index: Index of the shard. The first shard has the index 0.
    """
    return folder / f"shard-{index:05d}-of-{count:05d}.array_record"


def check_format(content: Any, folder: Path) -> None:
    """Check that this version of the library can read a dataset.

    Args:
        content: The content of the dataset's `collection.json`.
        folder: The folder of the dataset, for messages.

    Raises:
        DamagedFileError: The content does not describe a dataset.
        ValueError: The dataset was written by an older or newer version of the library.
    """
    if not isinstance(content, dict):
        raise DamagedFileError(
            f"{folder / 'collection.json'} does not describe a dataset: delete {folder} and collect the dataset again."
        )
    written = content.get("format", 1)  # the first format had no number
    if written != FORMAT:
        raise ValueError(
            f"{folder} is a dataset of format {written!r}, but this version of sts_jax reads format {FORMAT}: "
            f"delete {folder} and collect again, or choose another folder."
        )


def write_shard(
    path: Path, frames: Iterable[tuple[np.ndarray, ...]], arrays: dict[str, np.ndarray], identity: Identity
) -> None:
    """Write the two files of a shard: the images (`.array_record`) and all other data (`.npz`).

    Args:
        path: The `.array_record` file. The `.npz` file has the same path except for the suffix.
        frames: Batches of images in the order in which they are stored. The first batches have frames of trajectories,
            and each is a tuple `Images`. The last batches have views, and each is a tuple with one array of n visual
            images, uint8 `(n, height, width, 3)`. A view is a visual image of an object in an initial pose from which
            no trajectory is simulated.
        arrays: All other data, one array for each name in `records.ARRAYS`.
        identity: The identity of the shard, which `read_shard` checks.

    Raises:
        OSError: A file cannot be written. The message names it.
    """
    write_images(path, frames)
    known = {f"identity/{name}": np.array(value) for name, value in identity._asdict().items()}
    write_arrays(path.with_suffix(".npz"), {**arrays, **known, "identity/images": np.array(sha256(path))})


def read_shard(path: Path, identity: Identity) -> dict[str, np.ndarray]:
    """Read the arrays of a shard, after checking that its `.array_record` and `.npz` files belong together.

    Args:
        path: The `.array_record` file. The `.npz` file with the arrays is next to it.
        identity: The identity that the shard must have.

    Returns:
        The arrays given to `write_shard`.

    Raises:
        FileNotFoundError: A file is missing. The message names the file.
        DamagedFileError: A file is damaged, or belongs to another shard or dataset. The message names the file.
    """
    small = path.with_suffix(".npz")
    again = (
        f"delete {small.name} and {path.name}, then start the collection again. The collection makes only the missing "
        "shards"
    )
    arrays = read_arrays(small, again)
    names = {f"identity/{name}" for name in (*Identity._fields, "images")}
    lacking = sorted((names | ARRAYS) - set(arrays))
    if lacking:
        raise DamagedFileError(f"{small} lacks the arrays {', '.join(lacking)}: {again}.")
    there = {name.partition("/")[2]: arrays.pop(name).item() for name in names}
    if there["shard"] != identity.shard:
        raise DamagedFileError(
            f"{small} contains the data of shard {there['shard']} instead of shard {identity.shard}: {again}."
        )
    for name in ("collection", "sensor"):
        if there[name] != getattr(identity, name):
            raise DamagedFileError(
                f"{small} was made with a {name}.json that differs from {path.parent / name}.json: restore the "
                f"original {name}.json, or {again}."
            )
    if not path.is_file():
        raise _missing(path)
    if sha256(path) != there["images"]:
        raise DamagedFileError(
            f"{path} is damaged or belongs to another shard (the SHA-256 of the file differs from the value in "
            f"{small.name}): {again}."
        )
    return arrays


def write_images(path: Path, frames: Iterable[tuple[np.ndarray, ...]]) -> None:
    """Write images to an array_record file, as a whole or not at all.

    A record of the file contains the images of one frame, one image of each kind.

    Args:
        path: The file.
        frames: Batches of images. A batch of n frames is a tuple of arrays `(n, ...)`, one array per kind of image.
            `Images` is such a tuple.

    Raises:
        OSError: The file cannot be written. The message names it.
    """

    def write(temporary: Path) -> None:
        writer = _or_os_error(ArrayRecordWriter, str(temporary), WRITER_OPTIONS)
        for batch in frames:
            for images in zip(*batch, strict=True):
                record = [np.packbits(image) if image.dtype == bool else image for image in images]
                _or_os_error(writer.write, b"".join(image.tobytes() for image in record))
        _or_os_error(writer.close)

    write_whole(path, write)


def _or_os_error(call: Callable[..., Any], *args: Any) -> Any:
    """Call array_record, and turn the RuntimeError or ValueError that it raises on a full disk into an OSError."""
    try:
        return call(*args)
    except (RuntimeError, ValueError) as error:
        raise OSError(str(error)) from error


def read_images(path: Path, indices: np.ndarray, *, resolution: tuple[int, int], total: int) -> Images:
    """Read some frames of a shard.

    Args:
        path: The `.array_record` file.
        indices: Indices of the frames in the file, int `(n,)`.
        resolution: Height and width of every image (pixels).
        total: Number of records (frames and views) that the file must contain. A view is a visual image of an object in
            an initial pose from which no trajectory is simulated.

    Returns:
        The images of the n frames, in the given order.

    Raises:
        FileNotFoundError: The file does not exist.
        DamagedFileError: The file is truncated or does not contain `total` records.
    """
    height, width = resolution
    size = height * width * 3
    data = _read_records(path, indices, total)
    return Images(
        visual=data[:, :size].reshape(-1, height, width, 3),
        tactile=data[:, size : 2 * size].reshape(-1, height, width, 3),
        segmentation=np.unpackbits(data[:, 2 * size :], axis=1, count=height * width)
        .reshape(-1, height, width)
        .astype(bool),
    )


def read_views(path: Path, indices: np.ndarray, *, resolution: tuple[int, int], total: int) -> np.ndarray:
    """Read some views of a shard.

    A view is a visual image of an object in an initial pose from which no trajectory is simulated.

    Args:
        path: The `.array_record` file.
        indices: Indices of the views among all records of the file, int `(n,)`. The file contains all frames first,
            then the views.
        resolution: Height and width of every image (pixels).
        total: Number of records (frames and views) that the file must contain.

    Returns:
        The n images in the given order, uint8 `(n, height, width, 3)`.

    Raises:
        FileNotFoundError: The file does not exist.
        DamagedFileError: The file is truncated or does not contain `total` records.
    """
    return _read_records(path, indices, total).reshape(-1, *resolution, 3)


def _read_records(path: Path, indices: np.ndarray, total: int) -> np.ndarray:
    """Read some records of equal length, `uint8 (n, length)`."""
    if not path.is_file():
        raise _missing(path)
    again = (
        f"delete {path.name} and {path.with_suffix('.npz').name}, then start the collection again. The collection "
        "makes only the missing shards"
    )
    try:
        reader = ArrayRecordReader(str(path))
        count = reader.num_records()
        records = reader.read([int(i) for i in indices]) if count == total and len(indices) else []
        reader.close()
    except (RuntimeError, ValueError, IndexError) as error:
        raise DamagedFileError(f"{path} is damaged ({error}): {again}.") from error
    if count != total:
        raise DamagedFileError(
            f"{path} is damaged, because its number of records is {count} instead of {total}: {again}."
        )
    return np.frombuffer(b"".join(records), np.uint8).reshape(len(records), -1)


def _missing(path: Path) -> FileNotFoundError:
    return FileNotFoundError(f"{path} is missing: delete {path.with_suffix('.npz').name} and collect again.")
