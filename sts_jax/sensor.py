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
_BELOW = {"camera.fov": math.pi, "gel.max_tilt": 0.3}  # a tilt's slope is taken for its angle
_UP_TO_ONE = {"room.background", "room.vignette", "room.milk", "room.tint", "room.crease"}
_LARGEST, _LEAST = (float(x) for x in (np.finfo(np.float32).max, np.finfo(np.float32).tiny))  # beyond: inf and 0
_ROUNDED = 1 + 1e-6  # float32's last digit

_Condition = tuple[Any, Callable[[], str]]  # whether it holds, and what to say where it does not


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
        _insist(_conditions(self))

    def guard(self) -> tuple["Sensor", Bool[Array, ""] | bool]:
        """`check` under `jit`: what is known is checked, of what is traced a flag tells.

        Returns:
            This sensor, with the default's constants in the place of all traced ones where it cannot be; and whether
            it can be.

        Raises:
            ValueError: see `check`, of what is known: concrete values, and shapes.
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
        """Every constant in lists and numbers: what `save` writes as JSON."""
        return _plain(self)

    def save(self, path: str | os.PathLike) -> None:
        """Write every constant to one JSON file, whole or not at all.

        Args:
            path: of the file.

        Raises:
            ValueError: see `check`.
            OSError: the file cannot be written. The message names the file and the remedy.
        """
        self.check()
        write_json(Path(path), self.constants())

    @classmethod
    def load(cls, path: str | os.PathLike) -> "Sensor":
        """Read what `save` wrote.

        Args:
            path: of the file.

        Returns:
            Sensor.

        Raises:
            FileNotFoundError: there is no such file.
            OSError: the file cannot be read, or is torn or no JSON (`TornFileError`).
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
    # float32 by way of its shortest decimal
    return np.asarray(value).astype(str).astype(float).tolist()


def _typed(default: Any, value: Any, name: str) -> Any:
    """What a file says, of the default's types."""
    if not dataclasses.is_dataclass(default):
        _insist(_of_value(default, value, name))
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
        _insist(_of_rows(name, fields))
    return dataclasses.replace(default, **fields)


def _insist(conditions: Iterator[_Condition]) -> None:
    for holds, says in conditions:
        if not holds:
            raise ValueError(says())


def _default(sensor: Sensor) -> Sensor:
    return dataclasses.replace(type(sensor)(), lights=Leds() if isinstance(sensor.lights, Leds) else Lights())


def _conditions(sensor: Sensor) -> Iterator[_Condition]:
    """All that a sensor must fulfil; of traced values, traced."""
    yield from _of_fields(_default(sensor), sensor, "")
    distance, near = _array(sensor.camera.distance), _array(sensor.camera.near)
    thickness, max_depth = _array(sensor.gel.thickness), _array(sensor.gel.max_depth)
    yield (
        distance > thickness,
        lambda: (
            f"field camera.distance is {distance:g}, so the pinhole is in the gel or behind it; it must be above "
            f"gel.thickness, {thickness:g}."
        ),
    )
    yield (
        near <= _ROUNDED * (distance - thickness),
        lambda: (
            f"field camera.near is {near:g}, so that what presses on the gel may not be drawn; it must not be above "
            f"camera.distance - gel.thickness, {distance - thickness:g}."
        ),
    )
    yield (
        max_depth <= thickness,
        lambda: f"field gel.max_depth is {max_depth:g}; it must not be above gel.thickness, {thickness:g}.",
    )
    yield from _of_rows("lights", vars(sensor.lights))
    yield from _of_rows("room", vars(sensor.room))
    leds = isinstance(sensor.lights, Leds)
    name = "lights.positions" if leds else "lights.directions"
    rows = _array(sensor.lights.positions if isinstance(sensor.lights, Leds) else sensor.lights.directions)
    yield (
        (rows[:, 2] <= 0).all(),
        lambda: (
            f"field {name} has the row {rows[rows[:, 2] > 0][0].tolist()}, from outside of the skin, which lets no "
            "light in; z must not be above 0 (the camera's side is negative)."
        ),
    )
    if leds:
        half = _ROUNDED * _array(sensor.gel.size) / 2
        inside = (abs(rows[:, :2]) <= half[None, :]).all(axis=1) & (rows[:, 2] >= -_ROUNDED * thickness)
        yield (
            (~inside).all(),
            lambda: (
                f"field {name} has the row {rows[inside][0].tolist()}, inside the gel; over the pad z must be below "
                f"-gel.thickness, {-thickness:g}, or x or y beyond the pad's edge."
            ),
        )


def _of_fields(default: Any, value: Any, name: str) -> Iterator[_Condition]:
    if not dataclasses.is_dataclass(default):
        static = isinstance(default, int) or (isinstance(default, tuple) and isinstance(default[0], int))
        numbers = value if isinstance(value, tuple) else (value,)
        if isinstance(default, tuple) and not isinstance(value, tuple):
            raise ValueError(f"field {name} is {value!r}; it takes a tuple of {len(default)} numbers.")
        if isinstance(default, jax.Array) and not isinstance(value, jax.Array | np.ndarray):
            raise ValueError(f"field {name} is {value!r}; it takes an array.")
        if static and not all(isinstance(number, int | np.integer) for number in numbers):
            raise ValueError(f"field {name} is {value!r}; it takes whole numbers, of Python's or NumPy's kind.")
        yield from _of_value(default, value, name)
        return
    if type(value) is not type(default):
        raise ValueError(f"field {name} is {value!r}; it takes a {type(default).__name__}.")
    for field in dataclasses.fields(default):
        inner = f"{name}.{field.name}" if name else field.name
        yield from _of_fields(getattr(default, field.name), getattr(value, field.name), inner)


def _of_value(default: Any, value: Any, name: str) -> Iterator[_Condition]:
    """Numbers of the default's shape (of lights and lamps any number of rows), finite, in the field's range."""
    array, shape = _array(value), np.shape(default)
    wanted = "a finite number" if shape == () else f"finite numbers of shape {shape}"
    fits = array.shape == shape or (len(shape) == 2 and array.shape[1:] == shape[1:] and len(array) > 0)
    if array.dtype.kind not in "iuf" or not fits:
        raise ValueError(f"field {name} is {value!r}; it takes {wanted}.")
    whole = all(isinstance(d, int) for d in default) if isinstance(default, tuple) else isinstance(default, int)
    must: list[tuple[Any, str]] = [((abs(array) <= _LARGEST).all(), f"it takes {wanted}")]
    if whole:
        must.append(((array == array.round()).all(), "it takes whole numbers"))
    if name in _ABOVE_ZERO:
        must.append(((array >= _LEAST).all(), "it must be above 0"))
    if name in _NOT_BELOW_ZERO:
        must.append(((array >= 0).all(), "it must not be below 0"))
    if name in _BELOW:
        must.append(((array < _BELOW[name]).all(), f"it must be below {_BELOW[name]:.4f}"))
    if name in _UP_TO_ONE:
        must.append(((array <= 1).all(), "it must not be above 1"))
    for holds, words in must:
        yield holds, functools.partial("field {} is {!r}; {}.".format, name, value, words)


def _of_rows(name: str, fields: dict[str, Any]) -> Iterator[_Condition]:
    place = "positions" if "positions" in fields else "directions"
    rows, colors = _array(fields[place]), _array(fields["colors"])
    if len(rows) != len(colors):
        raise ValueError(
            f"fields {name}.{place}, {name}.colors have {(len(rows), len(colors))} rows; a light has one of both."
        )
    if place == "directions":
        yield (
            (rows != 0).any(axis=1).all(),
            lambda: f"field {name}.directions has a row of zeros: {rows.tolist()}; a direction needs a length.",
        )


def _array(value: Any) -> Any:
    """An array: traced if any of it is, else NumPy's, whose numbers are float64."""
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(value)):
        return jnp.asarray(value)
    try:
        array = np.asarray(value)
    except ValueError:  # rows of different lengths
        array = np.asarray(None)
    return array.astype(np.float64) if array.dtype.kind in "iuf" else array
