"""`View`: what the sensors in a MuJoCo scene see and feel, as a pure function of MuJoCo's data."""

import dataclasses
from collections.abc import Collection, Iterable, Iterator, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.spatial.transform import Rotation

from sts_jax import geometry
from sts_jax._checked import checked, in_32_bits, warn
from sts_jax._ranges import MOST_PIXELS
from sts_jax.frame import Frame
from sts_jax.objects.body import Body, is_traced
from sts_jax.physics.scene import mjx
from sts_jax.rendering.group import Group, draw_group, group
from sts_jax.scene.geometry import body_of, geom_name, visible
from sts_jax.scene.pad import BY_DISTANCE, DATA
from sts_jax.sensor import Sensor

_CONTACT = 17  # numbers that a sensor of `attach` stores of each contact
_OVERHANG = 1.02  # a pad may be larger than its finger by this factor
_BEHIND = 2e-4  # m, least depth of the finger's own colliding geoms below the pad's face, more than contacts sink in
_GEOM = mujoco.mjtObj.mjOBJ_GEOM


class _Contacts(NamedTuple):
    """Where the s contacts of a pad that MuJoCo's sensors store stand in the data."""

    places: Int[np.ndarray, "s 17"]  # indices into `sensordata`
    bodies: Int[np.ndarray, "s"]  # body on the other side of each contact
    signs: Float[np.ndarray, "s"]  # -1 where the normal that C MuJoCo stores points into the pad


class _Pad(NamedTuple):
    """One sensor of the scene, with k bodies that it can see. Numbers of bodies are MuJoCo's."""

    sensor: Sensor  # with `camera.near` at the gel's inner face
    site: int  # number of the site that is the sensor frame
    contacts: _Contacts
    bodies: Int[np.ndarray, "k"]  # bodies that it can see
    group: Group  # their geometry
    names: Int[np.ndarray, "k"]  # their places in `View.bodies`


class View:
    """The sensors in a MuJoCo scene. Calling it with MuJoCo's data returns one `Frame` for each sensor.

    A view is made once for a model, whose geometry it keeps. It is a pure function of the data, which works under
    `jit`, `vmap` and `grad`, and reads only `xpos`, `xquat`, `site_xpos`, `site_xmat` and `sensordata`:

        frames = view(data)                           # mujoco.MjData, or mjx.Data of one environment
        frames = jax.jit(jax.vmap(view))(batch)       # mjx.Data of many environments

    Each body that presses on a sensor has its own equilibrium on the gel. The body that carries a sensor is not seen by
    it (on the world: only the pad is not seen), and neither is anything below the gel.

    Attributes:
        bodies: Names of the bodies that are drawn, in the order of `Frame.body`.
    """

    @checked
    def __init__(
        self,
        model: mujoco.MjModel,
        sensors: Mapping[str, Sensor],
        *,
        bodies: Mapping[str, Body] = MappingProxyType({}),
        groups: Collection[int] | None = None,
        hide: Collection[str] = (),
    ) -> None:
        """Gather the geometry of a model.

        Args:
            model: Model that was compiled after `attach`.
            sensors: The sensor of each pad, by the name that `attach` got.
            bodies: Bodies that are drawn in place of the geoms of a MuJoCo body, by its name. Their mesh frame is the
                frame of the MuJoCo body.
            groups: Groups of geoms that are drawn. None: the visual geoms of each body (`contype` and `conaffinity` are
                0) and its geoms in the same groups, or all its geoms if it has no visual ones.
            hide: Names of bodies and geoms that are not drawn. Flexes, which are neither drawn nor felt, must be named.
        """
        if not sensors:
            raise ValueError("sensors is empty: name each pad and its sensor, as in {'left': sensor}")
        if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_SENSOR:
            raise ValueError('MuJoCo\'s sensors are switched off, so nothing is felt: remove <flag sensor="disable"/>')
        pads = {name: _pad_geom(model, name, sensor) for name, sensor in sensors.items()}
        for name in pads:
            _check_finger(model, name, pads)
            _check_timestep(model, name, pads[name])
        seen = _seen(model, pads, bodies, groups, hide)
        drawn = sorted(set().union(*seen.values()))
        self._shapes = {
            "xpos": (model.nbody, 3),
            "xquat": (model.nbody, 4),
            "site_xpos": (model.nsite, 3),
            "sensordata": (model.nsensordata,),
        }
        self._names = [_body_name(model, body) for body in range(model.nbody)]
        self.bodies: tuple[str, ...] = tuple(self._names[owner] for owner in drawn)
        self._pads = {
            name: _Pad(
                sensor=_without_housing(sensor),
                site=model.site(name).id,
                contacts=_contacts(model, pads[name]),
                bodies=np.array(list(seen[name])),
                group=group(list(seen[name].values())),
                names=np.searchsorted(drawn, list(seen[name])).astype(np.int32),
            )
            for name, sensor in sensors.items()
        }

    @in_32_bits
    @checked
    def __call__(
        self,
        data: mujoco.MjData | mjx.Data,
        *,
        wrenches: Mapping[str, Mapping[str, Float[Array | np.ndarray, "6"]]] | None = None,
        resolution: tuple[int, int] = (64, 64),
    ) -> dict[str, Frame]:
        """Render the images of all sensors.

        Args:
            data: Data after a step, or after `mj_forward`. For a batch use `jax.vmap`.
            wrenches: What presses on each pad, in the form of `View.wrenches`, such as a mean over the last steps.
                None: the wrenches of `data`.
            resolution: Height and width of the images (pixels).

        Returns:
            One frame for each sensor. `Frame.pose` and `Frame.balanced` have one row for each of the bodies that this
            sensor can see, in the order of `bodies`. `Frame.body` is the index in `bodies` of the body that is seen.
        """
        if not all(1 <= side <= MOST_PIXELS for side in resolution):
            raise ValueError(f"resolution (height, width) must be from 1 to {MOST_PIXELS:,} pixels, got {resolution}")
        given = self._given(wrenches)
        arrays, frames, by_c = self._read(data), {}, isinstance(data, mujoco.MjData)
        for name, pad in self._pads.items():
            poses = _poses(arrays, pad.site, pad.bodies)
            felt = _felt(arrays, pad, pad.bodies, by_c=by_c) if given is None else given[name]
            drawn = draw_group(pad.sensor, pad.group, poses, felt, resolution=resolution)
            body = jnp.where(drawn.body < 0, -1, jnp.asarray(pad.names)[drawn.body])
            frames[name] = Frame(**drawn._replace(body=body)._asdict())
        return frames

    @in_32_bits
    @checked
    def wrenches(self, data: mujoco.MjData | mjx.Data) -> dict[str, dict[str, Float[Array, "6"]]]:
        """Force (N) and moment (N m) that each sensor exerts on each body that can touch it, in the sensor frame."""
        arrays, wrenches, by_c = self._read(data), {}, isinstance(data, mujoco.MjData)
        for name, pad in self._pads.items():
            bodies = np.unique(pad.contacts.bodies)
            rows = zip(bodies.tolist(), _felt(arrays, pad, bodies, by_c=by_c), strict=True)
            wrenches[name] = {self._names[body]: row for body, row in rows}
        return wrenches

    def _given(self, wrenches: Mapping[str, Mapping[str, Any]] | None) -> dict[str, Float[Array, "k 6"]] | None:
        """Wrenches in the order of the bodies that each pad can see."""
        if wrenches is None:
            return None
        for name, pad in self._pads.items():
            wanted = {self._names[body] for body in pad.contacts.bodies}
            if wrenches.keys() != self._pads.keys() or wrenches[name].keys() != wanted:
                raise ValueError(
                    f"wrenches must have the pads {sorted(self._pads)}, and for the pad {name!r} the bodies "
                    f"{sorted(wanted)}, got { ({pad: sorted(bodies) for pad, bodies in wrenches.items()}) }: give what "
                    "view.wrenches(data) returns, or its mean"
                )
        nothing = jnp.zeros(6)
        return {
            name: jnp.stack(
                [jnp.asarray(wrenches[name].get(self._names[body], nothing), jnp.float32) for body in pad.bodies]
            )
            for name, pad in self._pads.items()
        }

    def _read(self, data: Any) -> "_Arrays":
        """The public arrays of MuJoCo's data, in 32 bits."""
        if np.ndim(data.xpos) > 2:
            raise ValueError(f"data is a batch (xpos has the shape {data.xpos.shape}): use jax.vmap(view)(data)")
        for name, shape in self._shapes.items():
            if np.shape(getattr(data, name)) != shape:
                raise ValueError(
                    f"data.{name} has the shape {np.shape(getattr(data, name))}, but in the view's model it has "
                    f"{shape}: this is the data of another model, so make a View of that model"
                )
        if not is_traced(data.xquat) and not np.any(np.asarray(data.xquat)):
            raise ValueError("data has no positions yet: call mj_forward (in MJX, mjx.forward) before")
        xmat = jnp.asarray(data.site_xmat, jnp.float32).reshape(-1, 3, 3)
        arrays = {name: jnp.asarray(getattr(data, name), jnp.float32) for name in self._shapes}
        return _Arrays(**arrays, site_xmat=xmat)


class _Arrays(NamedTuple):
    """What is read of MuJoCo's data."""

    xpos: Float[Array, "b 3"]
    xquat: Float[Array, "b 4"]
    site_xpos: Float[Array, "t 3"]
    sensordata: Float[Array, "d"]
    site_xmat: Float[Array, "t 3 3"]


@jax.jit
def _poses(arrays: _Arrays, site: Int[Array, ""], bodies: Int[Array, "k"]) -> Float[Array, "k 7"]:
    """Poses of bodies in a sensor frame."""
    turn = arrays.site_xmat[site]
    position = jnp.matmul(arrays.xpos[bodies] - arrays.site_xpos[site], turn, precision="highest")
    inverse = geometry.quat_inverse(geometry.quat_from_matrix(turn))
    return jnp.concatenate([position, geometry.quat_multiply(inverse, arrays.xquat[bodies])], axis=1)


def _felt(arrays: _Arrays, pad: _Pad, bodies: Int[np.ndarray, "k"], *, by_c: bool) -> Float[Array, "k 6"]:
    """Wrenches that a pad exerts on bodies, in the sensor frame."""
    counts = pad.contacts.bodies[None, :] == bodies[:, None]
    signs = pad.contacts.signs if by_c else None
    return _wrenches(arrays, pad.site, pad.contacts.places, counts, signs, pad.sensor.gel.thickness)


@jax.jit
def _wrenches(
    arrays: _Arrays,
    site: Int[Array, ""],
    places: Int[Array, "s 17"],
    counts: Bool[Array, "k s"],
    signs: Float[Array, "s"] | None,
    thickness: Float[Array, ""] | float,
) -> Float[Array, "k 6"]:
    contact = arrays.sensordata[places]
    distance = contact[:, 7]
    force, torque, point, normal, tangent = (contact[:, k : k + 3] for k in (1, 4, 8, 11, 14))
    turn = arrays.site_xmat[site]
    frame = jnp.matmul(jnp.stack([normal, tangent, jnp.cross(normal, tangent)], axis=1), turn, precision="highest")
    point = jnp.matmul(point - arrays.site_xpos[site], turn, precision="highest")
    if signs is None:
        signs = _outward(point, frame[:, 0], distance, thickness)
    force, torque = (jnp.einsum("s,si,sij->sj", signs, x, frame, precision="highest") for x in (force, torque))
    return jnp.matmul(
        counts.astype(jnp.float32),
        jnp.concatenate([force, jnp.cross(point, force) + torque], axis=1),
        precision="highest",
    )


def _outward(
    point: Float[Array, "s 3"],
    normal: Float[Array, "s 3"],
    distance: Float[Array, "s"],
    thickness: Float[Array, ""] | float,
) -> Float[Array, "s"]:
    """1 where a normal points out of the pad, and -1 where it points into it. The data of MJX 3.17 have both.

    Out of the pad is away from a point deep inside it. What sinks in nearly as deep as the gel is thick, comes from
    above: the finger is below.
    """
    inside = jnp.where(distance > -0.8 * thickness, -0.9 * thickness, point[:, 2] - thickness / 2)
    away = point.at[:, 2].add(-inside)
    return jnp.sign(jnp.sum(away * normal, axis=1))


def _pad_geom(model: mujoco.MjModel, name: str, sensor: Sensor) -> int:
    """Number of a pad's geom, after checks that the model fits the sensor."""
    sensor.check()
    pad = mujoco.mj_name2id(model, _GEOM, name)
    if pad < 0 or mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, name) < 0:
        raise ValueError(
            f"the model has no pad {name!r}: call scene.attach(spec, site, sensor, name={name!r}) before spec.compile()"
        )
    (width, height), thickness = sensor.gel.size, float(sensor.gel.thickness)
    wanted = np.array([float(width), float(height), thickness])
    if not np.allclose(2 * model.geom_size[pad], wanted, rtol=1e-4):
        raise ValueError(
            f"the pad {name!r} measures {_millimetres(2 * model.geom_size[pad])}, but its sensor has a gel of "
            f"{_millimetres(wanted)}: give the sensor that scene.attach got"
        )
    touchable = _touchable(model, pad)
    if missing := sorted({*touchable.tolist()} - {other for other, _ in _sensors(model, pad)}):
        raise ValueError(
            f"geom {geom_name(model, missing[0])} can touch the pad {name!r}, but no sensor measures it: add all "
            "bodies to the specification before scene.attach"
        )
    return int(pad)


def _check_finger(model: mujoco.MjModel, name: str, pads: Mapping[str, int]) -> None:
    """Raise a ValueError if a pad faces the body that carries it, or is larger, seen along the pad's normal.

    A geom of this body that collides at the pad's face, too, takes a part of the force, and causes a warning.
    """
    pad, site = pads[name], model.site(name)
    carrier = int(model.geom_bodyid[pad])
    geoms = np.setdiff1d(np.flatnonzero(model.geom_bodyid == carrier), list(pads.values())).tolist()
    if carrier == 0 or not len(geoms):
        return
    turn = Rotation.from_quat(site.quat, scalar_first=True).as_matrix()
    corners = []
    for geom in geoms:
        turned = Rotation.from_quat(model.geom_quat[geom], scalar_first=True).apply(_corners(model, geom))
        corners.append((turned + model.geom_pos[geom] - site.pos) @ turn)
    size, finger = 2 * model.geom_size[pad][:2], np.ptp(np.concatenate(corners), axis=0)[:2]
    if (size > _OVERHANG * finger).any():
        raise ValueError(
            f"the pad {name!r} measures {_millimetres(size)}, but the body {_body_name(model, carrier)!r} that carries "
            f"it only {_millimetres(finger)} there: turn the site, whose z axis must point out of the finger, use a "
            f"smaller sensor, such as Sensor.sized({finger.min():.3g}), or put the site on a body without other geoms"
        )
    thickness = 2 * model.geom_size[pad][2]
    over = [part for part in corners if (part.min(axis=0)[:2] < 0).all() and (part.max(axis=0)[:2] > 0).all()]
    depth = np.concatenate([*over, np.zeros((1, 3))])[:, 2]
    if depth.max() > thickness and depth.min() > -thickness:
        raise ValueError(
            f"the pad {name!r} faces its own body {_body_name(model, carrier)!r}, which reaches "
            f"{_millimetres([depth.max()])} in front of the gel and not behind it: turn the site, whose z axis must "
            "point out of the finger"
        )
    low, high = (edge(np.concatenate(corners), axis=0) for edge in (np.min, np.max))
    if not ((low[:2] < 0).all() and (high[:2] > 0).all()):
        warn(
            f"the body {_body_name(model, carrier)!r} lies beside its pad {name!r}, not behind it: turn the site, "
            "whose z axis must point out of the finger"
        )
    for geom, part in zip(geoms, corners, strict=True):
        covers = (part.min(axis=0)[:2] < 0).all() and (part.max(axis=0)[:2] > 0).all()
        touches = (model.geom_contype[geom] | model.geom_conaffinity[geom]) and part[:, 2].max() > -_BEHIND
        if covers and touches and part[:, 2].min() < 0:
            warn(
                f"geom {geom_name(model, geom)} of the body {_body_name(model, carrier)!r} reaches to the face of its "
                f"pad {name!r} and collides, too, so the pad feels only a part of the force: move the site out of the "
                "finger by the gel's thickness, or set the geom's contype and conaffinity to 0"
            )


def _check_timestep(model: mujoco.MjModel, name: str, pad: int) -> None:
    """Warn of time steps at which MuJoCo makes a pad softer (`refsafe`), and its forces jitter."""
    constant = model.geom_solref[pad, 0]  # s, negative for a `Press`
    if 0 < constant < 2 * (1 - 1e-6) * model.opt.timestep:
        warn(
            f"the time step is {1e3 * model.opt.timestep:g} ms, at which the forces on the pad {name!r} jitter: set "
            f"option.timestep to at most {1e3 * constant / 2:g} ms"
        )


def _corners(model: mujoco.MjModel, geom: int) -> Float[np.ndarray, "n 3"]:
    """Corners of a geom in its own frame (m): of its mesh, or of its box."""
    mesh = model.geom_dataid[geom] if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH else -1
    if mesh >= 0:
        first = model.mesh_vertadr[mesh]
        return np.asarray(model.mesh_vert[first : first + model.mesh_vertnum[mesh]], np.float64)
    box = model.geom_aabb[geom]
    return box[:3] + np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), axis=-1).reshape(8, 3) * box[3:]


def _touchable(model: mujoco.MjModel, pad: int) -> Int[np.ndarray, "k"]:
    """Geoms whose contacts with a pad MuJoCo computes."""
    weld, owner = model.body_weldid, model.geom_bodyid
    parent = weld[model.body_parentid[weld]]
    mine, theirs = weld[owner[pad]], weld[owner]
    allowed = (model.geom_contype[pad] & model.geom_conaffinity) | (model.geom_contype & model.geom_conaffinity[pad])
    touches = (allowed != 0) & (theirs != mine)
    if not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_FILTERPARENT and mine != 0:
        touches &= (theirs == 0) | ((parent[owner] != mine) & (parent[owner[pad]] != theirs))
    low, high = np.minimum(owner, owner[pad]), np.maximum(owner, owner[pad])
    touches &= ~np.isin((low << 16) + high, model.exclude_signature)
    first, second = model.pair_geom1, model.pair_geom2
    return np.union1d(np.flatnonzero(touches), np.concatenate([second[first == pad], first[second == pad]]))


def _sensors(model: mujoco.MjModel, pad: int) -> Iterator[tuple[int, int]]:
    """Geoms on the other side of the contact sensors of a pad, with the numbers of these sensors."""
    for sensor in _contact_sensors(model):
        one, other = int(model.sensor_objid[sensor]), int(model.sensor_refid[sensor])
        if pad in (one, other):
            yield (other if pad == one else one), int(sensor)


def _contact_sensors(model: mujoco.MjModel) -> Int[np.ndarray, "n"]:
    kind = (model.sensor_type == mujoco.mjtSensor.mjSENS_CONTACT) & (model.sensor_objtype == _GEOM)
    kind &= (model.sensor_reftype == _GEOM) & (model.sensor_intprm[:, :2] == [DATA, BY_DISTANCE]).all(axis=1)
    return np.flatnonzero(kind)


def _contacts(model: mujoco.MjModel, pad: int) -> _Contacts:
    places, bodies = [np.zeros((0, _CONTACT), int)], [np.zeros(0, int)]
    signs = [np.zeros(0, np.float32)]
    for other, sensor in dict(_sensors(model, pad)).items():
        start, length = model.sensor_adr[sensor], model.sensor_dim[sensor]
        slots = length // _CONTACT
        places.append((start + np.arange(length)).reshape(slots, _CONTACT))
        bodies.append(np.full(slots, model.geom_bodyid[other]))
        # The normal points from the sensor's first geom to the second one.
        signs.append(np.full(slots, 1 if model.sensor_objid[sensor] == pad else -1, np.float32))
    return _Contacts(np.concatenate(places), np.concatenate(bodies), np.concatenate(signs))


def _without_housing(sensor: Sensor) -> Sensor:
    """A sensor whose camera begins to see at the gel's inner face. Below it is the housing, where nothing is seen."""
    near = float(sensor.camera.distance) - float(sensor.gel.thickness)
    return dataclasses.replace(sensor, camera=dataclasses.replace(sensor.camera, near=near))


def _seen(
    model: mujoco.MjModel,
    pads: Mapping[str, int],
    bodies: Mapping[str, Body],
    groups: Collection[int] | None,
    hide: Collection[str],
) -> dict[str, dict[int, Body]]:
    """What each pad can see: the geometry of each body by its number."""
    numbers = {_body_name(model, body): body for body in range(model.nbody)}
    _check_names(model, numbers, bodies, hide, pads)
    owner = model.geom_bodyid
    every = np.union1d(list(pads.values()), model.sensor_objid[_contact_sensors(model)])  # those of other views, too
    shown = np.union1d(visible(model, groups), every)
    shown = np.array([g for g in shown if not {model.geom(g).name, _body_name(model, owner[g])} & {*hide}], int)
    replaced = {numbers[name]: body for name, body in bodies.items() if name not in hide}
    made: dict[tuple[int, ...], Body] = {}

    def geometry_of(number: int, pad: int) -> Body | None:
        geoms = tuple(shown[(owner[shown] == number) & (shown != pad)].tolist())
        if geoms and number not in replaced and geoms not in made:
            made[geoms] = body_of(model, geoms)
        return replaced.get(number, made.get(geoms))

    seen: dict[str, dict[int, Body]] = {}
    for name, pad in pads.items():
        others = [n for n in sorted({*owner[shown].tolist(), *replaced}) if n != owner[pad] or n == 0]
        seen[name] = {n: body for n in others if (body := geometry_of(n, pad)) is not None}
        if not seen[name]:
            raise ValueError(f"the sensor {name!r} can see no body: add one to the model, or hide fewer")
    return seen


def _check_names(
    model: mujoco.MjModel,
    names: Collection[str],
    bodies: Mapping[str, Body],
    hide: Collection[str],
    pads: Mapping[str, int],
) -> None:
    listed = ", ".join(map(repr, names))
    for name in bodies:
        if name not in names:
            raise ValueError(f"bodies has the name {name!r}, but the model has only the bodies {listed}")
        carried = [pad for pad, geom in pads.items() if _body_name(model, model.geom_bodyid[geom]) == name]
        if carried:
            raise ValueError(
                f"bodies has the name {name!r}, but this body carries the pad {carried[0]!r}: a body is a pad or an "
                "object, not both"
            )
        bodies[name].check()
    flexes = [mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_FLEX, k) or f"flex {k}" for k in range(model.nflex)]
    for name in flexes:
        if name not in hide:
            raise ValueError(f"flex {name!r} can be neither drawn nor felt: leave it out with hide=[{name!r}]")
    for name in hide:
        if name not in {*names, *flexes} and mujoco.mj_name2id(model, _GEOM, name) < 0:
            raise ValueError(
                f"hide has the name {name!r}, which is no geom, and the model has only the bodies {listed}"
            )


def _body_name(model: mujoco.MjModel, body: int | np.integer) -> str:
    return model.body(body).name or f"body {body}"


def _millimetres(size: Iterable[float]) -> str:
    return " x ".join(f"{1e3 * side:.4g}" for side in size) + " mm"
