"""`attach`: a sensor's pad as part of a MuJoCo specification, with MuJoCo's sensors that measure what touches it.

For every geom that can touch the pad there is one contact sensor (`mjSENS_CONTACT`) between two geoms, which stores up
to SLOTS contacts. Sensors between bodies, and MuJoCo's own sums (`reduce="netforce"`), do not exist in MJX's
JAX implementation. Of its ways to choose the contacts that are stored, only the one by distance leaves out contacts of
other geoms in all cases.
"""

import dataclasses
from collections.abc import Iterator
from dataclasses import field
from typing import Any

import mujoco
import numpy as np

from sts_jax import _ranges
from sts_jax._checked import checked
from sts_jax._ranges import COUNT, POSITIVE
from sts_jax.physics import Contact
from sts_jax.physics.scene import CONDIM
from sts_jax.sensor import Sensor
from sts_jax.tactile import Gel

SLOTS = 8  # contacts that MuJoCo finds at most between two geoms, except for those of `_MANY`
MANY_SLOTS = 50  # the same for the types in `_MANY` (mjMAXCONPAIR)
_MANY = mujoco.mjtGeom.mjGEOM_HFIELD, mujoco.mjtGeom.mjGEOM_SDF
# What a sensor stores of each contact: found (1), force (3), torque (3), dist (1), pos (3), normal (3), tangent (3).
DATA = sum(
    1 << int(getattr(mujoco.mjtConDataField, f"mjCONDATA_{name}"))
    for name in ("FOUND", "FORCE", "TORQUE", "DIST", "POS", "NORMAL", "TANGENT")
)
BY_DISTANCE = 1  # how the stored contacts are chosen, `reduce="mindist"`
GREATER = 1e6  # weight of the pad's contact constants when MuJoCo averages those of two geoms
COLOR = (0.7, 0.7, 0.8, 1.0)  # of the pad in the views of other sensors (paper's code)
_QUAT = mujoco.mjtOrientation.mjORIENTATION_QUAT
_PLAIN: Any = {"quat": [1, 0, 0, 0], "fromto": [np.nan] * 6}  # the defaults of a specification may turn and stretch
IMPEDANCE = 0.9  # MuJoCo's solimp at any depth, for `Press`


@dataclasses.dataclass(frozen=True)
class Press:
    """A press that sinks as deep into the pad in the physics as in the picture.

    An area A that presses with the force F sinks by F / (k A) into a gel of stiffness k. In MuJoCo, n contacts on a
    mass m with the impedance d and the stiffness s (`solref`) sink by F (1 - d) / (n m s), so

        s = k A (1 - d) / (n m)

    Other forces on the same area, too, then sink as deep in the physics as in the picture.
    """

    force: float = field(metadata=POSITIVE)  # N, must not sink deeper than `gel.max_depth`
    area: float = field(metadata=POSITIVE)  # m^2
    # Mass of the object (kg). If both the pad and the object move: 1 / w, with the sum w of the two bodies'
    # `model.body_invweight0[:, 0]`.
    mass: float = field(metadata=POSITIVE)
    contacts: int = field(default=4, metadata=COUNT)  # Number of contact points, four for a face of a box.

    def solref(self, gel: Gel) -> tuple[float, float]:
        """Stiffness and damping (negative, MuJoCo's direct form) of a pad with the impedance `IMPEDANCE`."""
        _ranges.check(self, "press.")
        depth = self.force / (float(gel.stiffness) * self.area)
        if depth > float(gel.max_depth):
            raise ValueError(
                f"press.force is {self.force:g} N on {self.area:g} m^2, which sinks {1e3 * depth:.3g} mm deep, but "
                f"gel.max_depth is {1e3 * float(gel.max_depth):.3g} mm: give a smaller force or a larger area"
            )
        soft = (1 - IMPEDANCE) / self.contacts
        stiffness = float(gel.stiffness) * self.area * soft / self.mass
        # The contacts act together as one oscillator, whose mass seems larger by n d / (1 - d).
        damping = 2 * Contact().damping_ratio * np.sqrt(stiffness * (soft + IMPEDANCE))
        return -stiffness, -float(damping)


@checked
def attach(
    spec: mujoco.MjSpec,
    site: str,
    sensor: Sensor,
    *,
    name: str,
    friction: float | None = None,
    press: Press | None = None,
) -> None:
    """Add a sensor's pad to a specification, at a site whose frame becomes the sensor frame (z out of the gel).

    This adds the geom `name`, a box without mass whose upper face is the plane z = 0 of the site, the site `name`, and
    contact sensors for all geoms that can touch the pad. Add all bodies before: `View` refuses a model with a geom that
    can touch the pad and has no sensor. Unnamed geoms get names.

    The pad has the constants of `physics.Contact`, whose short time constant needs time steps of at most 1.5 ms. The
    options of the specification stay as they are: use `cone="elliptic"` and an `impratio` of 10 or more, else what is
    held slips.

    Two constants of the other geom win over those of the pad, as everywhere in MuJoCo: all of a geom with a `priority`
    above 0, unless `friction` is given, and a negative `solref`. The pad's `contype` and `conaffinity` are 1.

    Args:
        spec: Specification with all bodies that can touch the pad.
        site: Name of the site.
        sensor: The sensor, whose gel has the size of the pad.
        name: Name of the pad.
        friction: Coefficient of sliding friction of the pad with everything. None: that of the other geom.
        press: None for stiff contacts, which sink in by less than 0.1 mm at rest, while the picture shows the imprint.
    """
    place = spec.site(site)
    if place is None:
        raise ValueError(
            f"the specification has no site {site!r}, only {', '.join(repr(s.name) for s in spec.sites) or 'none'}: "
            "add a site whose z axis points out of the gel"
        )
    if not np.isnan(place.fromto[0]):
        raise ValueError(f"the site {site!r} is given by fromto: give its frame by pos, and by quat, euler or zaxis")
    if spec.geom(name) is not None or (name != site and spec.site(name) is not None):
        raise ValueError(f"the specification has a geom or a site {name!r} already: choose another name for the pad")
    if friction is not None and not mujoco.mjMINMU <= friction < np.inf:  # MJX computes NaN without friction
        raise ValueError(f"friction must be >= {mujoco.mjMINMU} and finite, got {friction}")
    sensor.check()
    constants, gel = Contact(), sensor.gel
    solref, solimp = (constants.time_constant, constants.damping_ratio), (constants.soft, constants.hard)
    if press is not None:
        solref, solimp = press.solref(gel), (IMPEDANCE, IMPEDANCE)
    (width, height), thickness = gel.size, float(gel.thickness)
    owner, units, quat = place.parent, place.compiler, place.quat
    if place.alt.type != _QUAT:  # the units are those of the file that the site comes from
        quat = spec.resolve_orientation(degree=units.degree, sequence=units.eulerseq, orientation=place.alt)
    frame = owner.add_frame(pos=place.pos, quat=quat)
    if place.frame is not None:
        frame.set_frame(place.frame)
    pad = owner.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[float(width) / 2, float(height) / 2, thickness / 2],
        pos=[0, 0, -thickness / 2],
        **_PLAIN,
        meshname="",
        mass=0,
        contype=1,
        conaffinity=1,
        condim=CONDIM,
        friction=[mujoco.mjMINMU] * 3 if friction is None else [friction, constants.torsional, constants.rolling],
        priority=0 if friction is None else 1 + max((geom.priority for geom in spec.geoms), default=0),
        solref=solref,
        solimp=[*solimp, constants.width, 0.5, 2],
        solmix=GREATER,
        margin=0,
        gap=0,
        group=0,
        rgba=COLOR,
        material="",
    )
    pad.alt.type = _QUAT
    pad.set_frame(frame)
    if name != site:
        own = owner.add_site(name=name, pos=[0, 0, 0], **_PLAIN)
        own.alt.type = _QUAT
        own.set_frame(frame)
    _add_contact_sensors(spec, pad)


def _add_contact_sensors(spec: mujoco.MjSpec, pad: mujoco.MjsGeom) -> None:
    root, taken = _moves_with(pad.parent), {geom.name for geom in spec.geoms}
    for other in spec.geoms:
        collide = (pad.contype & other.conaffinity) or (other.contype & pad.conaffinity)
        if not collide or _moves_with(other.parent) == root:
            continue
        if not other.name:
            other.name = next(new for new in _names(f"{other.parent.name or 'geom'}") if new not in taken)
            taken.add(other.name)
        spec.add_sensor(
            name=f"{pad.name} on {other.name}",
            type=mujoco.mjtSensor.mjSENS_CONTACT,
            objtype=mujoco.mjtObj.mjOBJ_GEOM,
            objname=pad.name,
            reftype=mujoco.mjtObj.mjOBJ_GEOM,
            refname=other.name,
            intprm=[DATA, BY_DISTANCE, MANY_SLOTS if other.type in _MANY else SLOTS],
        )


def _moves_with(body: mujoco.MjsBody) -> mujoco.MjsBody:
    """The body that has the joints with which a body moves, the world for fixed bodies."""
    while body.parent is not None and not body.joints and not body.mocap:
        body = body.parent
    return body


def _names(stem: str) -> Iterator[str]:
    number = 0
    while True:
        yield f"{stem}_{number}"
        number += 1
