"""Shards on disk: whole files or none, the same bytes from the same inputs.

A shard is two files. `NAME.array_record` holds one record per rendered frame: the visual image, the tactile image
(`uint8`, `(height, width, 3)`) and the segmentation (bits), in that order. `NAME.npz` holds everything small as
named arrays and is written last: a shard without it does not exist.
"""

import io
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from array_record.python.array_record_module import ArrayRecordReader, ArrayRecordWriter

from sts_jax._files import TornFileError, write_bytes, write_whole

# One frame per group, so that a random read inflates one frame only.
WRITER_OPTIONS = "group_size:1,zstd:3"


class Images(NamedTuple):
    """Rendered frames as they are stored."""

    visual: np.ndarray  # uint8 (n, height, width, 3)
    tactile: np.ndarray  # uint8 (n, height, width, 3)
    segmentation: np.ndarray  # bool (n, height, width)


def write_arrays(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Write named arrays to an `.npz` file, whole or not at all."""
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **arrays)
    write_bytes(path, buffer.getvalue())


def write_images(path: Path, frames: Iterable[Images]) -> None:
    """Write the frames of each batch in order to an array_record file, whole or not at all."""

    def write(temporary: Path) -> None:
        writer = ArrayRecordWriter(str(temporary), WRITER_OPTIONS)
        for batch in frames:
            for visual, tactile, segmentation in zip(*batch, strict=True):
                writer.write(visual.tobytes() + tactile.tobytes() + np.packbits(segmentation).tobytes())
        writer.close()

    write_whole(path, write)


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Read what `write_arrays` wrote.

    Raises:
        FileNotFoundError: No such file.
        TornFileError: The file is not a whole `.npz`; delete it and collect again.
    """
    try:
        with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as arrays:
            return dict(arrays)
    except FileNotFoundError:
        raise
    except Exception as error:  # a torn zip shows as any of five exception types
        raise TornFileError(f"{path} is torn ({error}); delete it and start the collection again.") from error


def read_images(path: Path, indices: np.ndarray, *, resolution: tuple[int, int], total: int) -> Images:
    """Read some frames of a shard.

    Args:
        path: The `.array_record` file.
        indices: Which records, `(n,)`.
        resolution: Height and width of every image.
        total: How many records the file must hold (from the shard's arrays).

    Raises:
        FileNotFoundError: No such file.
        TornFileError: The file is truncated or holds another number of records.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path} is missing; delete {path.with_suffix('.npz').name} and collect again.")
    torn = f"{path} is torn; delete it and {path.with_suffix('.npz').name} and start the collection again"
    try:
        reader = ArrayRecordReader(str(path))
        count = reader.num_records()
        records = reader.read([int(i) for i in indices]) if count == total and len(indices) else []
        reader.close()
    except (RuntimeError, ValueError, IndexError) as error:
        raise TornFileError(f"{torn}: {error}.") from error
    if count != total:
        raise TornFileError(f"{torn}: it holds {count} frames instead of {total}.")
    height, width = resolution
    size = height * width * 3
    data = np.frombuffer(b"".join(records), np.uint8).reshape(len(records), -1)
    return Images(
        visual=data[:, :size].reshape(-1, height, width, 3),
        tactile=data[:, size : 2 * size].reshape(-1, height, width, 3),
        segmentation=np.unpackbits(data[:, 2 * size :], axis=1, count=height * width)
        .reshape(-1, height, width)
        .astype(bool),
    )
