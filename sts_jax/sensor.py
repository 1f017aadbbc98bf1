"""All constants of one sensor."""

import dataclasses
import functools
import math
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from sts_jax._files import read_json, write_json
from sts_jax.optics import Camera, Room
from sts_jax.tactile import Gel, Leds, Lights, Phong, Skin

_LIGHTS = {"Lights": Lights, "Leds": Leds}  # by their kind in a file
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
_BELOW = {"camera.fov": math.pi, "gel.max_tilt": 0.3}  # the gel takes the slope of a tilt for its angle
_UP_TO_ONE = {"room.background", "room.vignette", "room.milk", "room.tint", "room.crease"}
_LARGEST, _LEAST = (float(x) for x in (np.finfo(np.float32).max, np.finfo(np.float32).tiny))  # beyond: inf and 0
_ROUNDED = 1 + 1e-6  # tolerance for float32's last digit

_Condition = tuple[Any, Callable[[], str]]  # whether it holds, and the message if it does not


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Sensor:
    """An STS sensor. Every constant is a field. The defaults are the paper's where it gives a value."""

    camera: Camera = dataclasses.field(default_factory=Camera)
    gel: Gel = dataclasses.field(default_factory=Gel)
    lights: Lights | Leds = dataclasses.field(default_factory=Lights)  # far lights or near ones
    phong: Phong = dataclasses.field(default_factory=Phong)
    skin: Skin = dataclasses.field(default_factory=Skin)
    room: Room = dataclasses.field(default_factory=Room)
    # images with a shorter side below this (pixels) are sampled every half pixel and filtered. Ours.
    fine_below: int = dataclasses.field(default=128, metadata={"static": True})

    def check(self) -> None:
        """Raise an error if a constant is out of range. Runs on the host with concrete values, never under `jit`.

        Every field has its shape, is finite and lies in its range. The pinhole lies at least `camera.near` in front of
        the gel, so that objects on the gel are drawn. The imprint is not deeper than the gel. No light shines from
        outside through the paint: far lights come from the camera's side or lie in the gel's plane, and LEDs lie on the
        camera's side of the gel's outer face. Over the pad's area, LEDs lie in front of the gel. They may lie beside
        the gel, where light enters by its edges, and behind the pinhole, which hides nothing.

        Raises:
            ValueError: a field is out of range. The message names it, its value and the allowed values.
        """
        _insist(_conditions(self))

    def guard(self) -> tuple["Sensor", Bool[Array, ""] | bool]:
        """`check` under `jit`: raise errors for concrete values, and return a flag for traced ones.

        Returns:
            This sensor, and whether all its constants are in range. If not, all traced constants are replaced by the
            default's.

        Raises:
            ValueError: see `check`, for concrete values and for shapes.
        """
        flags = []
        for holds, says in _conditions(self):
            if isinstance(holds, jax.core.Tracer):
                flags.append(holds)
            elif not holds:
                raise ValueError(says())
        if not flags:
            return self, True
        sound = jnp.all(jnp.stack(flags))

        def safe(value: Any, default: Any) -> Any:
            if not isinstance(value, jax.core.Tracer):
                return value
            if value.shape != jnp.shape(default):  # another number of lights
                default = jnp.broadcast_to(default[:1], value.shape)
            return jnp.where(sound, value, default)

        leaves, structure = jax.tree.flatten(self)
        known = jax.tree.leaves(_default(self))
        return jax.tree.unflatten(structure, [safe(*pair) for pair in zip(leaves, known, strict=True)]), sound

    def constants(self) -> dict[str, Any]:
        """Every constant as lists and numbers, as `save` writes it to JSON."""
        return _plain(self)

    def save(self, path: str | os.PathLike) -> None:
        """Write every constant to one JSON file, whole or not at all.

        Args:
            path: path of the file.

        Raises:
            ValueError: see `check`.
            OSError: the file cannot be written. The message names the file and the remedy.
        """
        self.check()
        write_json(Path(path), self.constants())

    @classmethod
    def load(cls, path: str | os.PathLike) -> "Sensor":
        """Read a sensor from a file that `save` wrote.

        Args:
            path: path of the file.

        Returns:
            The sensor.

        Raises:
            FileNotFoundError: the file does not exist.
            OSError: the file cannot be read, or is torn or not JSON (`TornFileError`).
            ValueError: a field is missing, unknown, of another shape or out of range (`check`).
        """
        values = read_json(Path(path), "write it again with Sensor.save")
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
    # float32 as its shortest decimal
    return np.asarray(value).astype(str).astype(float).tolist()


def _typed(default: Any, value: Any, name: str) -> Any:
    """Convert the values of a file to the types of the default."""
    if not dataclasses.is_dataclass(default):
        _insist(_of_value(default, value, name))
        if isinstance(default, tuple):
            return tuple(type(d)(v) for d, v in zip(default, value, strict=True))
        return type(default)(value) if isinstance(default, int | float) else jnp.asarray(value, jnp.float32)
    known = [f.name for f in dataclasses.fields(default)]
    if not isinstance(value, dict):
        raise ValueError(f"field {name or 'sensor'} is {value!r}, but it must have the fields {', '.join(known)}.")
    prefix = f"{name}." if name else ""
    if name == "lights":
        kinds = ", ".join(_LIGHTS)
        if "kind" not in value:
            raise ValueError(f"field lights.kind is missing, but it must be one of {kinds}.")
        if value["kind"] not in list(_LIGHTS):
            raise ValueError(f"field lights.kind is {value['kind']!r}, but it must be one of {kinds}.")
        default = _LIGHTS[value["kind"]]()
        known = [f.name for f in dataclasses.fields(default)]
        value = {k: v for k, v in value.items() if k != "kind"}
    for missing in [k for k in known if k not in value]:
        raise ValueError(f"field {prefix}{missing} is missing. Write the file again with Sensor.save.")
    for unknown in [k for k in value if k not in known]:
        raise ValueError(f"field {prefix}{unknown} is unknown. The known fields are {', '.join(known)}.")
    fields = {k: _typed(getattr(default, k), value[k], prefix + k) for k in known}
    if "colors" in fields:
        _insist(_of_rows(name, fields))
    return dataclasses.replace(default, **fields)


def _insist(conditions: Iterator[_Condition]) -> None:
    for holds, says in conditions:
        if not holds:
            raise ValueError(says())


def _default(sensor: Sensor) -> Sensor:
    return dataclasses.replace(type(sensor)(), lights=Leds() if isinstance(sensor.lights, Leds) else Lights())


def _conditions(sensor: Sensor) -> Iterator[_Condition]:
    """All conditions on a sensor. Conditions on traced values are traced."""
    yield from _of_fields(_default(sensor), sensor, "")
    distance, near = _array(sensor.camera.distance), _array(sensor.camera.near)
    thickness, max_depth = _array(sensor.gel.thickness), _array(sensor.gel.max_depth)
    yield (
        distance > thickness,
        lambda: (
            f"field camera.distance is {distance:g}, but it must be > gel.thickness = {thickness:g}, so that the "
            "pinhole is in front of the gel."
        ),
    )
    yield (
        near <= _ROUNDED * (distance - thickness),
        lambda: (
            f"field camera.near is {near:g}, but it must be <= camera.distance - gel.thickness = "
            f"{distance - thickness:g}, so that objects that press on the gel are drawn."
        ),
    )
    yield (
        max_depth <= thickness,
        lambda: f"field gel.max_depth is {max_depth:g}, but it must be <= gel.thickness = {thickness:g}.",
    )
    yield from _of_rows("lights", vars(sensor.lights))
    yield from _of_rows("room", vars(sensor.room))
    leds = isinstance(sensor.lights, Leds)
    name = "lights.positions" if leds else "lights.directions"
    rows = _array(sensor.lights.positions if isinstance(sensor.lights, Leds) else sensor.lights.directions)
    yield (
        (rows[:, 2] <= 0).all(),
        lambda: (
            f"field {name} has the row {rows[rows[:, 2] > 0][0].tolist()}, but z must be <= 0, on the camera's side, "
            "because the skin lets no light in from outside."
        ),
    )
    if leds:
        half = _ROUNDED * _array(sensor.gel.size) / 2
        inside = (abs(rows[:, :2]) <= half[None, :]).all(axis=1) & (rows[:, 2] >= -_ROUNDED * thickness)
        yield (
            (~inside).all(),
            lambda: (
                f"field {name} has the row {rows[inside][0].tolist()}, which lies in the gel, but z must be < "
                f"-gel.thickness = {-thickness:g}, or x or y must be beyond the pad's edge."
            ),
        )


def _of_fields(default: Any, value: Any, name: str) -> Iterator[_Condition]:
    if not dataclasses.is_dataclass(default):
        static = isinstance(default, int) or (isinstance(default, tuple) and isinstance(default[0], int))
        numbers = value if isinstance(value, tuple) else (value,)
        if isinstance(default, tuple) and not isinstance(value, tuple):
            raise ValueError(f"field {name} is {value!r}, but it must be a tuple of {len(default)} numbers.")
        if isinstance(default, jax.Array) and not isinstance(value, jax.Array | np.ndarray):
            raise ValueError(f"field {name} is {value!r}, but it must be an array.")
        if static and not all(isinstance(number, int | np.integer) for number in numbers):
            raise ValueError(f"field {name} is {value!r}, but its numbers must be Python's or NumPy's integers.")
        yield from _of_value(default, value, name)
        return
    if type(value) is not type(default):
        raise ValueError(f"field {name} is {value!r}, but it must be a {type(default).__name__}.")
    for field in dataclasses.fields(default):
        inner = f"{name}.{field.name}" if name else field.name
        yield from _of_fields(getattr(default, field.name), getattr(value, field.name), inner)


def _of_value(default: Any, value: Any, name: str) -> Iterator[_Condition]:
    """Conditions on a value: the default's shape (with any number of lights or lamps), finite and in range."""
    array, shape = _array(value), np.shape(default)
    wanted = "a finite number" if shape == () else f"an array of finite numbers of shape {shape}"
    fits = array.shape == shape or (len(shape) == 2 and array.shape[1:] == shape[1:] and len(array) > 0)
    if array.dtype.kind not in "iuf" or not fits:
        raise ValueError(f"field {name} is {value!r}, but it must be {wanted}.")
    whole = all(isinstance(d, int) for d in default) if isinstance(default, tuple) else isinstance(default, int)
    must: list[tuple[Any, str]] = [((abs(array) <= _LARGEST).all(), f"it must be {wanted}")]
    if whole:
        must.append(((array == array.round()).all(), "its numbers must be whole"))
    if name in _ABOVE_ZERO:
        must.append(((array >= _LEAST).all(), "it must be > 0"))
    if name in _NOT_BELOW_ZERO:
        must.append(((array >= 0).all(), "it must be >= 0"))
    if name in _BELOW:
        must.append(((array < _BELOW[name]).all(), f"it must be < {_BELOW[name]:.4f}"))
    if name in _UP_TO_ONE:
        must.append(((array <= 1).all(), "it must be <= 1"))
    for holds, words in must:
        yield holds, functools.partial("field {} is {!r}, but {}.".format, name, value, words)


def _of_rows(name: str, fields: dict[str, Any]) -> Iterator[_Condition]:
    place = "positions" if "positions" in fields else "directions"
    rows, colors = _array(fields[place]), _array(fields["colors"])
    if len(rows) != len(colors):
        raise ValueError(
            f"fields {name}.{place} and {name}.colors have {(len(rows), len(colors))} rows, but every light needs one "
            "row in both."
        )
    if place == "directions":
        yield (
            (rows != 0).any(axis=1).all(),
            lambda: f"field {name}.directions has a row of zeros, but a direction needs a length: {rows.tolist()}.",
        )


def _array(value: Any) -> Any:
    """Convert a value to an array, traced if any part of it is, else NumPy's with float64 numbers."""
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(value)):
        return jnp.asarray(value)
    try:
        array = np.asarray(value)
    except ValueError:  # rows of different lengths
        array = np.asarray(None)
    return array.astype(np.float64) if array.dtype.kind in "iuf" else array
