"""Rounded weights in one small file, for models that are shared.

The kernel of a layer is stored as integers q and steps s, `w = q s`. Each output channel has its own step, the root
mean square of its weights divided by 128, so that a weight changes by at most half a step. A compressed weight takes
about 1.2 bytes, compared with 1.9 in half precision. Vectors, such as biases, are stored unchanged.
"""

import io
from pathlib import Path

import numpy as np
from jaxtyping import ArrayLike

NAME = "weights.npz"
_LEVELS = 128  # steps in a channel's root mean square
_LARGEST = 2**15 - 1  # of q, which has 16 bits (a channel with a larger weight has a longer step)
_STEP = ":step"  # appended to the name of a kernel


def write(path: Path, arrays: dict[str, ArrayLike]) -> None:
    """Write arrays by name: float32 arrays of two or more axes rounded, others unchanged.

    Args:
        path: the file, with the suffix `.npz`.
        arrays: arrays by name. The output channels are the last axis of a kernel.

    Raises:
        OSError: the file cannot be written.
    """
    stored = {}
    for name, array in arrays.items():
        stored[name] = values = np.asarray(array)
        if values.dtype != np.float32 or values.ndim < 2:
            continue
        inputs = tuple(range(values.ndim - 1))
        rms = np.sqrt(np.mean(np.square(values, dtype=np.float64), axis=inputs))
        step = np.maximum(rms / _LEVELS, np.abs(values).max(axis=inputs) / _LARGEST).astype(np.float32)
        number = np.rint(values / np.where(step == 0, 1, step)).astype(np.int32)
        # High bytes take few values, and compress better if no low bytes lie between them.
        stored[name] = np.stack([number >> 8, number & 255]).astype(np.uint8)
        stored[name + _STEP] = step
    np.savez_compressed(path, allow_pickle=False, **stored)


def read(path: Path) -> dict[str, np.ndarray]:
    """Read the arrays by name from a file that `write` wrote. Rounded arrays become float32.

    Raises:
        Exception: the file is damaged. zipfile, zlib and NumPy raise many types.
    """
    with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as file:
        stored = dict(file)
    arrays = {name: values for name, values in stored.items() if not name.endswith(_STEP)}
    for name in arrays:
        if name + _STEP in stored:
            high, low = arrays[name].view(np.int8)[0], arrays[name][1]
            arrays[name] = (high * np.float32(256) + low) * stored[name + _STEP]
    return arrays
