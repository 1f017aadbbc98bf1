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
from sts_jax.tactile import Gel, Leds, Lights, Phong, Skin

_LIGHTS = {"Lights": Lights, "Leds": Leds}  # by the word that a file has for them
# fmt: off
_ABOVE_ZERO = {
    "camera.distance", "camera.fov", "camera.aspect", "camera.near", "gel.size", "gel.thickness", "gel.stiffness",
    "gel.max_depth", "gel.max_tilt", "gel.tolerance", "gel.cells", "lights.reference", "phong.shininess",
    "phong.darkening", "skin.shadow_reach", "skin.penumbra", "room.haze", "room.crease_height", "room.rim_depth",
    "room.exposure",
}
_NOT_BELOW_ZERO = {
    "lights.colors", "lights.falloff", "phong.ambient", "phong.diffuse", "phong.specular", "phong.ambient_color",
    "skin.coupling", "skin.shadow_steps", "room.ambient", "room.colors", "room.background", "room.vignette",
    "room.rim", "room.milk", "room.tint", "room.crease", "fine_below",
}
# fmt: on
_BELOW = {"camera.fov": math.pi, "gel.max_tilt": math.pi / 2}
_UP_TO_ONE = {"room.background", "room.vignette", "room.milk", "room.tint", "room.crease"}


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Sensor:
    """An STS sensor; every constant is a field, the defaults are the paper's where it gives one."""

    camera: Camera = dataclasses.field(default_factory=Camera)
    gel: Gel = dataclasses.field(default_factory=Gel)
    lights: Lights | Leds = dataclasses.field(default_factory=Lights)  # far, or near ones
    phong: Phong = dataclasses.field(default_factory=Phong)
    skin: Skin = dataclasses.field(default_factory=Skin)
    room: Room = dataclasses.field(default_factory=Room)
    # images with a shorter side below this (pixels) are sampled at half a pixel's distance and filtered; ours
    fine_below: int = dataclasses.field(default=128, metadata={"static": True})

    def check(self) -> None:
        """See that this is a sensor that can be: on the host, of concrete values, never under `jit`.

        Every field is of its shape, finite and in its range. The pinhole lies in front of the gel, nearer than which
        nothing is left out (`camera.near`); the imprint is no deeper than the gel. No light shines from outside
        through the paint: far lights come from the camera's side or lie in the gel's plane, and LEDs lie on the
        camera's side of its outer face, those over the pad's area in front of the gel. Beside the gel (light that
        enters by its edges) and behind the pinhole, which hides nothing, an LED may be.

        Raises:
            ValueError: the field, its value and what it may be.
        """
        lights = Leds() if isinstance(self.lights, Leds) else Lights()
        _check_fields(dataclasses.replace(type(self)(), lights=lights), self, "")
        camera, gel = self.camera, self.gel
        if camera.distance <= gel.thickness:
            raise ValueError(
                f"field camera.distance is {camera.distance!r}, so the pinhole is in the gel or behind it; it must be "
                f"above gel.thickness, {gel.thickness!r}."
            )
        if camera.near > camera.distance - gel.thickness:
            raise ValueError(
                f"field camera.near is {camera.near!r}, so that what presses on the gel may not be drawn; it must not "
                f"be above camera.distance - gel.thickness, {camera.distance - gel.thickness:g}."
            )
        if gel.max_depth > gel.thickness:
            raise ValueError(
                f"field gel.max_depth is {gel.max_depth!r}; it must not be above gel.thickness, {gel.thickness!r}."
            )
        near = isinstance(self.lights, Leds)
        place = "positions" if near else "directions"
        _check_rows("lights", vars(self.lights))
        _check_rows("room", vars(self.room))
        half = (1 + 1e-6) * np.asarray(gel.size, np.float64) / 2  # float32's last digit
        for row in np.asarray(getattr(self.lights, place), np.float64):
            if row[2] > 0:
                raise ValueError(
                    f"field lights.{place} has the row {row.tolist()}, from outside of the skin, which lets no light "
                    "in; z must not be above 0 (the camera's side is negative)."
                )
            if near and np.all(np.abs(row[:2]) <= half) and row[2] >= -(1 + 1e-6) * gel.thickness:
                raise ValueError(
                    f"field lights.{place} has the row {row.tolist()}, inside the gel; over the pad z must be below "
                    f"-gel.thickness, {-gel.thickness!r}, or x or y beyond the pad's edge."
                )

    def constants(self) -> dict[str, Any]:
        """Every constant in lists and numbers: what `save` writes as JSON."""
        return _plain(self)

    def save(self, path: str | os.PathLike) -> None:
        """Write every constant to one JSON file, whole or not at all.

        Args:
            path: of the file.

        Raises:
            ValueError: see `check`.
        """
        self.check()
        path = Path(path)
        part = path.with_name(path.name + ".part")
        part.write_text(json.dumps(self.constants(), indent=2) + "\n")
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
            ValueError: the file is torn, or a field is missing, unknown, of another shape or out of range (`check`).
        """
        try:
            values = json.loads(Path(path).read_text())
        except (json.JSONDecodeError, UnicodeDecodeError) as error:
            raise ValueError(f"{path} is torn or no JSON: {error}. Write it again with Sensor.save.") from error
        try:
            sensor = _typed(cls(), values, "")
            sensor.check()
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None
        return sensor


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        kind = {"kind": type(value).__name__} if isinstance(value, Lights | Leds) else {}
        return kind | {f.name: _plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, tuple):
        return [_plain(v) for v in value]
    if isinstance(value, int | float):
        return value
    # float32 by way of its shortest decimal
    return np.asarray(value).astype(str).astype(float).tolist()


def _typed(default: Any, value: Any, name: str) -> Any:
    """What a file says, of the default's types."""
    if not dataclasses.is_dataclass(default):
        _check_value(default, value, name)
        if isinstance(default, tuple):
            return tuple(type(d)(v) for d, v in zip(default, value, strict=True))
        return type(default)(value) if isinstance(default, int | float) else jnp.asarray(value, jnp.float32)
    known = [f.name for f in dataclasses.fields(default)]
    if not isinstance(value, dict):
        raise ValueError(f"field {name or 'sensor'} is {value!r}; it takes the fields {', '.join(known)}.")
    prefix = f"{name}." if name else ""
    if name == "lights":
        kinds = ", ".join(_LIGHTS)
        if "kind" not in value:
            raise ValueError(f"field lights.kind is missing; known are {kinds}.")
        if value["kind"] not in list(_LIGHTS):
            raise ValueError(f"field lights.kind is {value['kind']!r}; known are {kinds}.")
        default = _LIGHTS[value["kind"]]()
        known = [f.name for f in dataclasses.fields(default)]
        value = {k: v for k, v in value.items() if k != "kind"}
    for missing in [k for k in known if k not in value]:
        raise ValueError(f"field {prefix}{missing} is missing. Write the file again with Sensor.save.")
    for unknown in [k for k in value if k not in known]:
        raise ValueError(f"field {prefix}{unknown} is not known; known are {', '.join(known)}.")
    fields = {k: _typed(getattr(default, k), value[k], prefix + k) for k in known}
    if "colors" in fields:
        _check_rows(name, fields)
    return dataclasses.replace(default, **fields)


def _check_fields(default: Any, value: Any, name: str) -> None:
    if not dataclasses.is_dataclass(default):
        _check_value(default, value, name)
        return
    if type(value) is not type(default):
        raise ValueError(f"field {name} is {value!r}; it takes a {type(default).__name__}.")
    for field in dataclasses.fields(default):
        inner = f"{name}.{field.name}" if name else field.name
        _check_fields(getattr(default, field.name), getattr(value, field.name), inner)


def _check_value(default: Any, value: Any, name: str) -> None:
    """Numbers of the default's shape (of lights and lamps any number of rows), finite, in the field's range."""
    try:
        array = np.asarray(value)
    except ValueError:  # rows of different lengths
        array = np.asarray(None)
    shape = np.shape(default)
    fits = array.shape == shape or (len(shape) == 2 and array.shape[1:] == shape[1:] and len(array) > 0)
    if array.dtype.kind not in "iuf" or not fits or not np.all(np.isfinite(array)):
        wanted = "a finite number" if shape == () else f"finite numbers of shape {shape}"
        raise ValueError(f"field {name} is {value!r}; it takes {wanted}.")
    array = array.astype(np.float64)
    whole = all(isinstance(d, int) for d in default) if isinstance(default, tuple) else isinstance(default, int)
    if whole and np.any(array != np.round(array)):
        raise ValueError(f"field {name} is {value!r}; it takes whole numbers.")
    if name in _ABOVE_ZERO and not np.all(array > 0):
        raise ValueError(f"field {name} is {value!r}; it must be above 0.")
    if name in _NOT_BELOW_ZERO and not np.all(array >= 0):
        raise ValueError(f"field {name} is {value!r}; it must not be below 0.")
    if name in _BELOW and not np.all(array < _BELOW[name]):
        raise ValueError(f"field {name} is {value!r}; it must be below {_BELOW[name]:.4f}.")
    if name in _UP_TO_ONE and not np.all(array <= 1):
        raise ValueError(f"field {name} is {value!r}; it must not be above 1.")


def _check_rows(name: str, fields: dict[str, Any]) -> None:
    place = "positions" if "positions" in fields else "directions"
    rows = len(fields[place]), len(fields["colors"])
    if rows[0] != rows[1]:
        raise ValueError(f"fields {name}.{place}, {name}.colors have {rows} rows; a light has one of both.")
    if place == "directions" and not np.all(np.any(np.asarray(fields[place]) != 0, axis=1)):
        given = np.asarray(fields[place]).tolist()
        raise ValueError(f"field {name}.directions has a row of zeros: {given}; a direction needs a length.")
