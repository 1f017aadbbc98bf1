"""Bodies of a simulation: their checks, mass properties, collision hulls, and the geometry that random starts need."""

import concurrent.futures
import math
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int

from sts_jax import objects
from sts_jax._checked import in_32_bits
from sts_jax._devices import cores
from sts_jax.objects.body import Body
from sts_jax.physics import contact
from sts_jax.physics.contact import Hull
from sts_jax.physics.rest import UPRIGHT, StableFaces
from sts_jax.physics.scenario import Hidden, Scenario, Shape

CONTENTS = 16  # random contents of each body, whose centres of mass a scenario with `by_contents` receives
AT_ONCE = 8  # draws whose mass properties one call computes

rigid_of_draws = jax.jit(jax.vmap(objects.rigid, in_axes=(None, 0, 0, 0)))  # one body, several draws


class BodyError(ValueError):
    """A body cannot be simulated.

    Attributes:
        body: Index of the body in the sequence of bodies.
    """

    def __init__(self, body: int, reason: str):
        super().__init__(f"body {body}: {reason}")
        self.body = body


def check_bodies(bodies: Sequence[Any]) -> None:
    """Raise a TypeError or a BodyError unless every item is a `Body` that can be simulated."""
    for i, body in enumerate(bodies):
        if not isinstance(body, Body):
            raise TypeError(f"body {i} is {body!r}, but it must be a Body, from objects.make or objects.load")
        if (
            body.hulls.ndim != 3
            or body.hulls.shape[1:] not in [(size, 3) for size in objects.HULL_CLASSES]
            or (body.hulls.shape[0] not in objects.PART_CLASSES)
        ):
            parts, points = (" or ".join(map(str, sizes)) for sizes in (objects.PART_CLASSES, objects.HULL_CLASSES))
            raise BodyError(
                i,
                f"hulls has shape {body.hulls.shape}, but it must be (p, n, 3) with p = {parts} convex parts of "
                f"n = {points} points: for several bodies, pass a sequence",
            )
        if not np.isfinite(body.hulls).all():
            raise BodyError(i, "the field `hulls` has a vertex that is not finite: repair the mesh")
        if not (np.isfinite(body.shell_mass) and body.shell_mass > 0):
            raise BodyError(
                i,
                f"shell_mass is {body.shell_mass} kg, but it must be > 0 and finite: pass the mass (kg) to "
                "objects.load",
            )
        try:
            body.check()
        except ValueError as error:
            raise BodyError(i, str(error)) from error


class Rigid(NamedTuple):
    """Mass properties and friction in n trajectories, float64."""

    mass: Float[np.ndarray, "n"]  # Mass (kg).
    com: Float[np.ndarray, "n 3"]  # Centre of mass in the mesh frame (m).
    inertia: Float[np.ndarray, "n 3 3"]  # Inertia about the centre of mass, along the mesh axes (kg m^2).
    friction: Float[np.ndarray, "n"]  # Coefficient of sliding friction against the pad.


@in_32_bits
def rigids(bodies: Sequence[Body], which: Int[np.ndarray, "n"], hidden: Hidden) -> Rigid:
    """Mass properties and friction of bodies with n sets of hidden properties (see `objects.rigid`).

    `which` is the index of the body of each set, in ascending order.
    """
    values = jax.tree.map(np.asarray, hidden)
    groups = [np.flatnonzero(which == index) for index in np.unique(which)]
    calls = [rows for group in groups for rows in np.split(group, range(AT_ONCE, len(group), AT_ONCE))]

    def computed(rows: np.ndarray) -> list[np.ndarray]:
        # Every call has the same number of draws, because another number would round differently and compile anew.
        draws = Hidden(*(x[np.resize(rows, AT_ONCE)] for x in values))
        rigid = rigid_of_draws(bodies[which[rows[0]]], draws.fill, draws.shell_scale, draws.up)
        return [np.asarray(x)[: len(rows)] for x in (*rigid, draws.friction)]

    # A call uses one core of a CPU. The first call compiles.
    parts = [computed(rows) for rows in calls[:1]]
    with concurrent.futures.ThreadPoolExecutor(cores()) as pool:
        parts += pool.map(in_32_bits(computed), calls[1:])
    return Rigid(*(np.concatenate(leaves).astype(np.float64) for leaves in zip(*parts, strict=True)))


def refusal(body: Body, scenario: Scenario) -> str | None:
    """Return the reason why a body cannot start in a scenario, such as "it rests on no face, ...", or None."""
    return _refusal(_faces(body), scenario)


def _refusal(faces: StableFaces, scenario: Scenario) -> str | None:
    if not len(faces.up):
        return "it rests on no face, because its centre of mass is not above the inside of any face"
    if scenario.must_stand and faces.up[:, 2].max() < math.cos(UPRIGHT):
        return f"it does not stand upright (+z up), but {type(scenario).__name__} needs an upright body"
    return None


def _faces(body: Body) -> StableFaces:
    """Find the faces on which a body without contents can rest."""
    points = np.asarray(body.hulls, np.float64).reshape(-1, 3)
    return StableFaces(*objects.rest_poses(points, np.asarray(body.shell_com, np.float64)))


def hulls(bodies: Sequence[Body]) -> list[Hull]:
    """Compute the collision hull of each body. A BodyError names one whose points span no volume."""
    made = []
    for index, body in enumerate(bodies):
        try:
            made.append(contact.hull(np.asarray(body.hulls)))
        except ValueError as error:
            raise BodyError(index, str(error)) from error
    return made


def shapes(bodies: Sequence[Body], scenario: Scenario) -> Shape:
    """Compute the geometry of each body, with a leading axis of bodies. A BodyError names one that cannot start."""
    faces = [_faces(body) for body in bodies]
    for index, stable in enumerate(faces):
        reason = _refusal(stable, scenario)
        if reason is not None:
            raise BodyError(index, f"{reason}: leave this body out")
    coms = np.stack([np.asarray(body.shell_com)[None] for body in bodies])
    if scenario.by_contents:
        hidden = jax.vmap(scenario.hidden)(jax.random.split(jax.random.key(0), CONTENTS))
        contents = hidden.fill, hidden.shell_scale, hidden.up
        coms = np.stack([np.asarray(rigid_of_draws(body, *contents)[1]) for body in bodies])
    return Shape(
        points=_padded([np.asarray(body.hulls).reshape(-1, 3) for body in bodies], "edge"),
        rests=_padded([stable.up for stable in faces], "edge"),
        shares=_padded([stable.share for stable in faces], "constant"),
        coms=coms,
    )


def _padded(arrays: Sequence[np.ndarray], mode: Literal["edge", "constant"]) -> np.ndarray:
    """Stack arrays of different lengths, padded with their last row ("edge") or with 0 ("constant")."""
    size = max(map(len, arrays))
    rest = ((0, 0),) * (arrays[0].ndim - 1)
    return np.stack([np.pad(x, ((0, size - len(x)), *rest), mode) for x in arrays]).astype(np.float32)
