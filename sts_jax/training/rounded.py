"""Rounded weights in one small file, for models that are shared.

A weight w of a kernel is stored as an integer q, with `w = q s`. Each output channel has its own step s: the root mean
square of the channel's weights, divided by 128. The step is larger if q would not fit into 16 bits. A weight changes by
at most half a step. In the compressed file, a weight takes about 1.2 bytes. In half precision, it would take 1.9 bytes.
Vectors, such as biases, are stored unchanged.
"""

import io
from pathlib import Path

import numpy as np
from jaxtyping import ArrayLike

NAME = "weights.npz"
_LEVELS = 128  # root mean square of the weights of a channel, in steps
_LARGEST = 2**15 - 1  # largest q, which has 16 bits. A channel with a larger weight has a longer step
_STEP = ":step"  # suffix of the name of the array that has the steps of a kernel


def write(path: Path, arrays: dict[str, ArrayLike]) -> None:
    """Write arrays to a compressed file. float32 arrays with two or more axes are rounded, all others are unchanged.

    The rounded values are multiples of a step. Values with the same index on the last axis (one output channel of a
    kernel) have the same step. The step is the larger of r / 128 and m / 32767, where r is the root mean
    square and m is the largest magnitude of these values.

    Args:
        path: File to write, with the suffix `.npz`.
        arrays: Arrays by name.

    Raises:
        OSError: The file cannot be written.
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
        # High and low bytes are stored apart, because the high bytes have few values and then compress better.
        stored[name] = np.stack([number >> 8, number & 255]).astype(np.uint8)
        stored[name + _STEP] = step
    np.savez_compressed(path, allow_pickle=False, **stored)


def read(path: Path) -> dict[str, np.ndarray]:
    """Read a file that was written by `write`.

    Args:
        path: File to read.

    Returns:
        Arrays by name. The arrays that `write` rounded before it stored them are returned as float32.

    Raises:
        Exception: The file is damaged. The type depends on the damage (errors of zipfile, zlib or NumPy).
    """
    with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as file:
        stored = dict(file)
    arrays = {name: values for name, values in stored.items() if not name.endswith(_STEP)}
    for name in arrays:
        if name + _STEP in stored:
            high, low = arrays[name].view(np.int8)[0], arrays[name][1]
            arrays[name] = (high * np.float32(256) + low) * stored[name + _STEP]
    return arrays
