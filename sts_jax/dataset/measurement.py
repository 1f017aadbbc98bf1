"""Specifications of further modalities, such as the contact force, besides the visual image, tactile image and pose."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

NAMES = ("visual", "tactile", "pose", "state")  # reserved names of the library's own inputs


@dataclasses.dataclass(frozen=True)
class Measurement:
    """Specification of a further modality, such as the contact force or an image of a second camera."""

    name: str  # name of the modality, other than `visual`, `tactile`, `pose` and `state`
    shape: tuple[int, ...]  # (size,) for a vector of numbers, or (height, width, channels) for an image in [0, 1]
    # Function that receives a `Dataset` and the indices of n trajectories. It returns the values in the first and last
    # frames, `(n, 2, *shape)`: numbers in SI units, or images as floats in [0, 1] or as uint8. If a value was not
    # measured, its numbers are NaN. Training and evaluation ignore such values.
    measure: Callable[[Any, np.ndarray], np.ndarray]
    unit: str = ""  # SI unit of the numbers, for tables
    scale: float = 1.0  # typical size of the numbers (SI units). The networks receive the numbers divided by this size
    weight: float = 1.0  # weight of the reconstruction error in the loss of `mvae` models

    def __post_init__(self) -> None:
        if not self.name.isidentifier() or self.name in NAMES:
            raise ValueError(
                f"name of a measurement is {self.name!r}: give a Python identifier other than {', '.join(NAMES)}"
            )
        if len(self.shape) not in (1, 3) or min(self.shape) < 1:
            raise ValueError(
                f"measurement {self.name!r}: shape is {self.shape}, but it must be (size,) for a vector or (height, "
                "width, channels) for an image"
            )
        for field in ("scale", "weight"):
            if not 0 < getattr(self, field) < np.inf:
                raise ValueError(
                    f"measurement {self.name!r}: {field} is {getattr(self, field)}, but it must be > 0 and finite"
                )
        if self.is_image and self.scale != 1:
            raise ValueError(f"measurement {self.name!r}: scale is {self.scale}, but an image needs no scale")

    @property
    def is_image(self) -> bool:
        """True for an image, False for a vector."""
        return len(self.shape) == 3


def measured(measurements: Sequence[Measurement], data: Any, trajectories: np.ndarray) -> dict[str, np.ndarray]:
    """Measure the first and last frames of n trajectories of a `Dataset`: uint8 or float32 `(n, 2, *shape)` by name."""
    names = [measurement.name for measurement in measurements]
    if len(set(names)) < len(names):
        raise ValueError(f"measurements has the names {names}, but each name may occur only once: rename one")
    return {each.name: _checked(each, each.measure(data, trajectories), len(trajectories)) for each in measurements}


def _checked(measurement: Measurement, values: Any, count: int) -> np.ndarray:
    """Check the result of `measure`, and return it as uint8 or float32."""
    values, wanted = np.asarray(values), (count, 2, *measurement.shape)
    start = f"measurement {measurement.name!r}: the function `measure` returned "
    if values.shape != wanted:
        raise ValueError(f"{start}an array of shape {values.shape}, but it must have shape {wanted}")
    if measurement.is_image and values.dtype == np.uint8:
        return values
    if values.dtype.kind not in "fiu":
        raise ValueError(f"{start}values of type {values.dtype}, but they must be real numbers: return floats")
    with np.errstate(over="ignore"):
        values = values.astype(np.float32)
    if np.isinf(values).any():
        raise ValueError(f"{start}infinite numbers: return finite numbers, and NaN for values that were not measured")
    if measurement.is_image and (np.nanmin(values, initial=0) < 0 or np.nanmax(values, initial=0) > 1):
        raise ValueError(
            f"{start}an image with values from {np.nanmin(values):.3g} to {np.nanmax(values):.3g}: return values in "
            "[0, 1], or uint8"
        )
    return values
