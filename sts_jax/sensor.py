"""`Sensor`: all constants of one sensor, with methods that check them, save them and load them."""

import contextlib
import dataclasses
import functools
import math
import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from sts_jax._checked import in_32_bits
from sts_jax._ranges import NOT_NEGATIVE, STATIC, limits
from sts_jax.optics import Camera, Room
from sts_jax.storage import DamagedFileError, digest, read_json, read_manifest, verify, write_json
from sts_jax.tactile import Gel, Leds, Lights, Markers, Phong, Skin

_LIGHTS: dict[str, type[Lights] | type[Leds]] = {"Lights": Lights, "Leds": Leds}  # by `lights.kind` in a file
_LARGEST = float(np.finfo(np.float32).max)  # larger numbers become inf in float32
_ROUNDED = 1 + 1e-6  # factor that tolerates rounding to float32
_SMALLEST, _WIDEST = 0.001, 1.0  # m, sides of a pad

_Condition = tuple[Any, Callable[[], str]]  # flag, True if the condition holds, and a function that makes the message


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Sensor:
    """All constants of an STS sensor (See-Through-your-Skin).

    The defaults are those of the paper (Rezaei-Shoshtari et al. 2021), where the paper gives a value.
    """

    camera: Camera = dataclasses.field(default_factory=Camera)  # Pinhole of the camera.
    gel: Gel = dataclasses.field(default_factory=Gel)  # Size and stiffness of the gel, and limits of its deformation.
    # Internal lights: directional lights (`Lights`), or points at a finite distance (`Leds`).
    lights: Lights | Leds = dataclasses.field(default_factory=Lights)
    phong: Phong = dataclasses.field(default_factory=Phong)  # Reflectance of the skin's inner side.
    skin: Skin = dataclasses.field(default_factory=Skin)  # Smoothing of the imprint, and shadows on the skin.
    room: Room = dataclasses.field(default_factory=Room)  # External light, and the view of it through the skin.
    markers: Markers | None = None  # Dots in the skin, which move when it shears. None: no dots, and no shear.
    # Images whose shorter side is below this number of pixels are sampled every half pixel and filtered. Our choice.
    fine_below: int = dataclasses.field(default=128, metadata=NOT_NEGATIVE | STATIC)

    @classmethod
    def sized(cls, width: float, height: float | None = None, *, like: "Sensor | None" = None) -> "Sensor":
        """Sensor of another size, geometrically similar to the default one, for a finger tip as well as a table.

        All lengths are multiplied by s = width / (width of the other pad): pad, camera, lights, skin and depths. The
        stiffness of the gel is multiplied by s^-3. An object s times as large then leaves s times as large an imprint
        under the same force, and the images are the same.

        Another ratio of height to width than the other pad's stretches the pad, the camera's view and the places of
        LEDs along y. The gel's grid keeps its number of cells, and their shape, as far as whole numbers allow.

        Args:
            width: Width of the pad along x (m).
            height: Height of the pad along y (m). None keeps the ratio.
            like: Sensor whose constants are scaled. None for the default sensor.
        """
        for name, side in (("width", width), ("height", height)):
            if side is not None and not _SMALLEST <= side <= _WIDEST:
                raise ValueError(
                    f"{name} must be from {_SMALLEST:g} to {_WIDEST:g} m, got {side!r}: give the size of the pad in "
                    "metres, not in millimetres"
                )
        like = cls() if like is None else like
        sensor = _scaled(like, width / float(like.gel.size[0]))
        if height is None:
            return sensor
        stretch = height / float(sensor.gel.size[1])
        camera, lights, (rows, columns) = sensor.camera, sensor.lights, sensor.gel.cells
        if isinstance(lights, Leds):
            lights = dataclasses.replace(lights, positions=lights.positions * jnp.array([1.0, stretch, 1.0]))
        return dataclasses.replace(
            sensor,
            camera=dataclasses.replace(
                camera,
                fov=2 * math.atan(math.tan(float(camera.fov) / 2) * stretch),
                aspect=float(camera.aspect) / stretch,
            ),
            gel=dataclasses.replace(
                sensor.gel,
                size=(sensor.gel.size[0], height),
                cells=(max(1, round(rows * stretch**0.5)), max(1, round(columns / stretch**0.5))),
            ),
            lights=lights,
        )

    def check(self) -> None:
        """Raise a ValueError that names the field, its value and the limit, if a constant is out of range.

        Every field must be finite, have the shape of its default and lie in its declared range, and:

        - The pinhole is at least `camera.near` below the gel's inner face, so that objects that press are drawn.
        - `gel.max_depth` is at most `gel.thickness`.
        - `markers.radius` is at most half of `markers.pitch`.
        - Every light, internal or external, has one row in `colors` and one in `directions` or `positions`.
        - No direction is zero. Internal lights have z <= 0, below the opaque skin, and LEDs do not lie in the gel.

        Constants that `jit` traces cannot be checked: use `guard`.
        """
        _require(_conditions(self))

    def guard(self) -> tuple["Sensor", Bool[Array, ""] | bool]:
        """Check a sensor whose constants may be traced by `jit`, and return it with a flag.

        If a traced constant is out of range, all traced constants have their default values and the flag is False. A
        constant that is not traced raises a ValueError, as in `check`.
        """
        flags = []
        for holds, message in _conditions(self):
            if isinstance(holds, jax.core.Tracer):
                flags.append(holds)
            elif not holds:
                raise ValueError(message())
        if not flags:
            return self, True
        # A sum, because XLA repeats the conditions of `jnp.all` in every kernel, and compiles a third longer.
        sound = jnp.sum(jnp.stack(flags).astype(jnp.int32)) == len(flags)

        def safe(value: Any, default: Any) -> Any:
            if not isinstance(value, jax.core.Tracer):
                return value
            if value.shape != jnp.shape(default):  # another number of lights than the default
                default = jnp.broadcast_to(default[:1], value.shape)
            return jnp.where(sound, value, default)

        leaves, structure = jax.tree.flatten(self)
        defaults = jax.tree.leaves(_default_of(self))
        return jax.tree.unflatten(structure, [safe(*pair) for pair in zip(leaves, defaults, strict=True)]), sound

    def constants(self) -> dict[str, Any]:
        """All constants as nested dictionaries with JSON values, as in the file that `save` writes."""
        return _plain(self)

    def save(self, path: str | os.PathLike) -> None:
        """Write all constants and their checksum to a JSON file, atomically."""
        self.check()
        write_json(Path(path), {**self.constants(), "checksum": digest(self.constants())})

    @classmethod
    def load(cls, path: str | os.PathLike) -> "Sensor":
        """Read a sensor from a file that `save` wrote, or from that of a real sensor, whose entry "device" is ignored.

        A missing field has its default value, and an unknown field raises a ValueError. The file is compared with its
        checksum, if it has one, and with the manifest of its folder, if that lists it.
        """
        path, again = Path(path), "write it again with Sensor.save"
        if not path.exists():
            raise FileNotFoundError(
                f"{path} does not exist: give a file that Sensor.save wrote, or the sensor.json of a dataset"
            )
        manifest = None
        with contextlib.suppress(DamagedFileError):  # a manifest of other programs
            manifest = read_manifest(path.parent, "")
        if manifest is not None and path.name in manifest.files:
            verify(path.parent, manifest, "restore it, or write a file of another name with Sensor.save", [path.name])
        values = read_json(path, again)
        if isinstance(values, dict):
            values.pop("device", None)
            if values.pop("checksum", None) not in (None, digest(values)):
                raise DamagedFileError(
                    f"{path} is damaged or was edited (its checksum differs): {again}, or delete the field `checksum` "
                    "to accept your changes."
                )
        try:
            sensor = _typed(cls(), values, "")
            sensor.check()
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None
        return sensor


def _scaled(value: Any, scale: float, power: int = 0) -> Any:
    """Multiply all constants by the scale to the power that their metadata state."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        powers = {f.name: f.metadata.get("metres", 0) for f in dataclasses.fields(value)}
        return dataclasses.replace(value, **{k: _scaled(getattr(value, k), scale, p) for k, p in powers.items()})
    if isinstance(value, tuple):
        return tuple(_scaled(v, scale, power) for v in value)
    return value * scale**power if power else value


def _plain(value: Any) -> Any:
    """Convert a dataclass, an array or a number to the types of JSON."""
    if dataclasses.is_dataclass(value):
        kind = {"kind": type(value).__name__} if isinstance(value, Lights | Leds) else {}
        fields = {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
        return kind | {name: _plain(field) for name, field in fields.items() if field is not None}
    if isinstance(value, tuple):
        return [_plain(v) for v in value]
    if isinstance(value, int | float):
        return value
    # The shortest decimal of each float32 number.
    return np.asarray(value).astype(str).astype(float).tolist()


def _typed(default: Any, value: Any, name: str, metadata: Mapping[str, Any] = MappingProxyType({})) -> Any:
    """Convert the values of a file to the types of the default value. Missing fields keep the default value."""
    if name == "markers" and value is not None:
        default = Markers()
    if default is None and value is None:
        return None
    if not dataclasses.is_dataclass(default):
        _require(_value_conditions(default, value, name, metadata))
        if isinstance(default, tuple):
            return tuple(type(d)(v) for d, v in zip(default, value, strict=True))
        return type(default)(value) if isinstance(default, int | float) else jnp.asarray(value, jnp.float32)
    if not isinstance(value, dict):
        subject = f"field {name}" if name else "the content"
        raise ValueError(f"{subject} is {value!r}, but it must be a JSON object.")
    if name == "lights" and "kind" in value:
        if value["kind"] not in list(_LIGHTS):
            raise ValueError(f"field lights.kind is {value['kind']!r}, but it must be one of {', '.join(_LIGHTS)}.")
        default, value = _LIGHTS[value["kind"]](), {k: v for k, v in value.items() if k != "kind"}
    fields = {field.name: field for field in dataclasses.fields(default)}
    prefix = f"{name}." if name else ""
    for unknown in sorted(value.keys() - fields.keys()):
        raise ValueError(f"field {prefix}{unknown} is unknown: use only the fields {', '.join(fields)}.")
    typed = {k: _typed(getattr(default, k), v, prefix + k, fields[k].metadata) for k, v in value.items()}
    if "colors" in fields:
        _require(_row_conditions(name, vars(default) | typed))
    return dataclasses.replace(default, **typed)


def _require(conditions: Iterator[_Condition]) -> None:
    for holds, message in conditions:
        if not holds:
            raise ValueError(message())


@functools.cache  # making its arrays takes a quarter of the time of a small image
@in_32_bits
def _default(kind: type[Sensor], lights: type[Lights | Leds], markers: bool) -> Sensor:
    """The default sensor with one kind of lights, with or without markers. Its arrays are not traced."""
    with jax.ensure_compile_time_eval():
        return dataclasses.replace(kind(), lights=lights(), markers=Markers() if markers else None)


def _default_of(sensor: Sensor) -> Sensor:
    kind: Any = type(sensor)  # mypy takes a class without hashable instances for unhashable
    return _default(kind, Leds if isinstance(sensor.lights, Leds) else Lights, sensor.markers is not None)


def _conditions(sensor: Sensor) -> Iterator[_Condition]:
    """Yield all conditions on a sensor. The flag of a condition on traced values is traced."""
    yield from _field_conditions(_default_of(sensor), sensor, "")
    distance, near = _array(sensor.camera.distance), _array(sensor.camera.near)
    thickness, max_depth = _array(sensor.gel.thickness), _array(sensor.gel.max_depth)
    yield (
        distance > thickness,
        lambda: f"field camera.distance is {distance:g}, but it must be > gel.thickness = {thickness:g}.",
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
    if sensor.markers is not None:
        radius, pitch = _array(sensor.markers.radius), _array(sensor.markers.pitch)
        yield (
            2 * radius <= _ROUNDED * pitch,
            lambda: f"field markers.radius is {radius:g}, but it must be <= markers.pitch / 2 = {pitch / 2:g}.",
        )
    yield from _row_conditions("lights", vars(sensor.lights))
    yield from _row_conditions("room", vars(sensor.room))
    leds = isinstance(sensor.lights, Leds)
    name = "lights.positions" if leds else "lights.directions"
    rows = _array(sensor.lights.positions if isinstance(sensor.lights, Leds) else sensor.lights.directions)
    yield (
        (rows[:, 2] <= 0).all(),
        lambda: (
            f"field {name} has the row {rows[rows[:, 2] > 0][0].tolist()}, but z must be <= 0, on the camera's side of "
            "the opaque skin."
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


def _field_conditions(
    default: Any, value: Any, name: str, metadata: Mapping[str, Any] = MappingProxyType({})
) -> Iterator[_Condition]:
    """Yield the conditions that every number is finite and in range. Raise a ValueError for a wrong type or shape."""
    if default is None:
        return
    if not dataclasses.is_dataclass(default):
        static = isinstance(default, int) or (isinstance(default, tuple) and isinstance(default[0], int))
        if isinstance(default, tuple) and not isinstance(value, tuple):
            raise ValueError(f"field {name} is {value!r}, but it must be a tuple of {len(default)} numbers.")
        if isinstance(default, jax.Array) and not isinstance(value, jax.Array | np.ndarray):
            raise ValueError(f"field {name} is {value!r}, but it must be a NumPy or JAX array.")
        numbers = value if isinstance(value, tuple) else (value,)
        if static and not all(isinstance(number, int | np.integer) for number in numbers):
            raise ValueError(f"field {name} is {value!r}, but it must have the type int.")
        yield from _value_conditions(default, value, name, metadata)
        return
    if type(value) is not type(default):
        allowed = "Lights or Leds" if isinstance(default, Lights | Leds) else type(default).__name__
        raise ValueError(f"field {name} is {value!r}, but it must be an instance of {allowed}.")
    for field in dataclasses.fields(default):
        inner = f"{name}.{field.name}" if name else field.name
        yield from _field_conditions(getattr(default, field.name), getattr(value, field.name), inner, field.metadata)


def _value_conditions(default: Any, value: Any, name: str, metadata: Mapping[str, Any]) -> Iterator[_Condition]:
    """Yield the conditions that a value is finite and in range. Raise a ValueError if its shape is not the default's.

    Two-dimensional values may have any number of rows, one for each light or lamp.
    """
    array, shape = _array(value), np.shape(default)
    rows = f"(n, {shape[1]}), with one row for each light" if len(shape) == 2 else str(shape)
    wanted = "a finite number" if shape == () else f"an array of finite numbers of shape {rows}"
    fits = array.shape == shape or (len(shape) == 2 and array.shape[1:] == shape[1:] and len(array) > 0)
    if array.dtype.kind not in "iuf" or not fits:
        raise ValueError(f"field {name} is {value!r}, but it must be {wanted}.")
    whole = all(isinstance(d, int) for d in default) if isinstance(default, tuple) else isinstance(default, int)
    must: list[tuple[Any, str]] = [((abs(array) <= _LARGEST).all(), f"it must be {wanted}")]
    if whole:
        must.append(((array == array.round()).all(), "its numbers must be whole"))
    for holds, words in must + limits(metadata, array):
        yield holds, functools.partial("field {} is {!r}, but {}.".format, name, value, words)


def _row_conditions(name: str, fields: dict[str, Any]) -> Iterator[_Condition]:
    """Yield the condition that no direction is zero. Raise a ValueError if the numbers of lights and colours differ."""
    place = "positions" if "positions" in fields else "directions"
    rows, colors = _array(fields[place]), _array(fields["colors"])
    if len(rows) != len(colors):
        raise ValueError(
            f"field {name}.{place} has the shape {rows.shape} and field {name}.colors has the shape {colors.shape}, "
            "but both must have one row for each light: give them the same number of rows."
        )
    if place == "directions":
        yield (
            (rows != 0).any(axis=1).all(),
            lambda: f"field {name}.directions is {rows.tolist()}, but every row must have a length > 0.",
        )


def _array(value: Any) -> Any:
    """Convert a value to a traced array if any part of it is traced, else to a NumPy array with float64 numbers."""
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(value)):
        return jnp.asarray(value)
    try:
        array = np.asarray(value)
    except ValueError:  # rows of different lengths
        array = np.asarray(None)
    return array.astype(np.float64) if array.dtype.kind in "iuf" else array
