"""All constants of one sensor."""

import dataclasses
import json
import math
import os
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sts_jax.optics import Camera, Room
from sts_jax.tactile import Gel, Lights, Phong

# fmt: off
_POSITIVE = {
    "camera.distance", "camera.fov", "camera.aspect", "camera.near", "gel.size", "gel.thickness", "gel.stiffness",
    "gel.max_depth", "gel.max_tilt", "gel.tolerance", "gel.cells", "phong.shininess", "phong.darkening", "room.haze",
}
# fmt: on


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Sensor:
    """An STS sensor; every constant is a field, the defaults are the paper's where it gives one."""

    camera: Camera = dataclasses.field(default_factory=Camera)
    gel: Gel = dataclasses.field(default_factory=Gel)
    lights: Lights = dataclasses.field(default_factory=Lights)
    phong: Phong = dataclasses.field(default_factory=Phong)
    room: Room = dataclasses.field(default_factory=Room)
    # images with a shorter side below this (pixels) are sampled at half a pixel's distance and filtered; ours
    fine_below: int = dataclasses.field(default=128, metadata={"static": True})

    def save(self, path: str | os.PathLike) -> None:
        """Write every constant to one JSON file, whole or not at all.

        Args:
            path: of the file.
        """
        path = Path(path)
        part = path.with_name(path.name + ".part")
        part.write_text(json.dumps(_plain(self), indent=2) + "\n")
        part.replace(path)

    @classmethod
    def load(cls, path: str | os.PathLike) -> "Sensor":
        """Read what `save` wrote.

        Args:
            path: of the file.

        Returns:
            Sensor.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: the file is torn, or a field is missing, unknown, of another shape or out of range.
        """
        text = Path(path).read_text()
        try:
            values = json.loads(text)
        except json.JSONDecodeError as error:
            raise ValueError(f"{path} is torn or no JSON: {error}. Write it again with Sensor.save.") from error
        return _typed(cls(), values, "", str(path))


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        return {f.name: _plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, tuple):
        return [_plain(v) for v in value]
    if isinstance(value, int | float):
        return value
    # float32 by way of its shortest decimal
    return np.asarray(value).astype(str).astype(float).tolist()


def _typed(default: Any, value: Any, name: str, path: str) -> Any:
    if dataclasses.is_dataclass(default) and not isinstance(default, type):
        known = [f.name for f in dataclasses.fields(default)]
        if not isinstance(value, dict):
            raise ValueError(f"{path}: field {name or 'sensor'} is {value!r}; it takes the fields {', '.join(known)}.")
        prefix = f"{name}." if name else ""
        for missing in set(known) - set(value):
            raise ValueError(f"{path}: field {prefix}{missing} is missing. Write the file again with Sensor.save.")
        for unknown in set(value) - set(known):
            raise ValueError(f"{path}: field {prefix}{unknown} is not known; known are {', '.join(known)}.")
        fields = {k: _typed(getattr(default, k), value[k], prefix + k, path) for k in known}
        if name == "lights" and len(fields["directions"]) != len(fields["colors"]):
            rows = len(fields["directions"]), len(fields["colors"])
            raise ValueError(
                f"{path}: fields lights.directions, lights.colors have {rows} rows; a light has one of both."
            )
        return dataclasses.replace(default, **fields)
    try:
        array = np.asarray(value, np.float64)
    except (TypeError, ValueError):
        array = np.asarray(np.nan)
    shape = np.shape(default)
    # Lights and lamps may be any number of rows.
    fits = array.shape == shape or (len(shape) == 2 and array.ndim == 2 and array.shape[1] == shape[1])
    if not (fits and np.all(np.isfinite(array))):
        raise ValueError(f"{path}: field {name} is {value!r}; it takes finite numbers of shape {shape}.")
    if name in _POSITIVE and not np.all(array > 0):
        raise ValueError(f"{path}: field {name} is {value!r}; it must be above 0.")
    if name == "camera.fov" and array >= math.pi:
        raise ValueError(f"{path}: field {name} is {value!r}; it must be below pi.")
    whole = all(isinstance(d, int) for d in default) if isinstance(default, tuple) else isinstance(default, int)
    if whole and np.any(array != np.round(array)):
        raise ValueError(f"{path}: field {name} is {value!r}; it takes whole numbers.")
    if isinstance(default, tuple):
        return tuple(type(d)(v) for d, v in zip(default, value, strict=True))
    if isinstance(default, (int, float)):
        return type(default)(value)
    return jnp.asarray(array, jnp.float32)
