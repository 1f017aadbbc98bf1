"""Checks of the bodies of a simulation, and the geometry that collisions and random starts need."""

import math
from collections.abc import Sequence
from typing import Any, Literal

import jax
import numpy as np

from sts_jax import objects
from sts_jax.objects.body import Body
from sts_jax.physics import contact
from sts_jax.physics.contact import Hull
from sts_jax.physics.mass_properties import rigid_of_draws
from sts_jax.physics.rest import UPRIGHT, StableFaces
from sts_jax.physics.scenario import Scenario, Shape

CONTENTS = 16  # random contents of each body, whose centres of mass a scenario with `by_contents` receives


class BodyError(ValueError):
    """A body cannot be simulated.

    Attributes:
        body: Index of the body in the sequence of bodies.
    """

    def __init__(self, body: int, reason: str):
        super().__init__(f"body {body}: {reason}")
        self.body = body


def check_bodies(bodies: Sequence[Any]) -> None:
    """Raise an error unless every item is a `Body` that can be simulated.

    Raises:
        TypeError: An item is not a `Body`.
        BodyError: `hulls` has an unsupported shape or a non-finite value, `shell_mass` is not positive and finite, or
            `Body.check` finds an error.
    """
    for i, body in enumerate(bodies):
        if not isinstance(body, Body):
            raise TypeError(
                f"body {i} is {body!r}, but it must be a Body: objects.make generates one, objects.load reads a mesh "
                "file. For several bodies, pass a sequence"
            )
        known = body.hulls.ndim == 3 and body.hulls.shape[1] in objects.HULL_CLASSES
        if not known or body.hulls.shape[0] not in objects.PART_CLASSES:
            parts, points = (" or ".join(map(str, sizes)) for sizes in (objects.PART_CLASSES, objects.HULL_CLASSES))
            raise BodyError(
                i,
                f"hulls has shape {body.hulls.shape}, but it must be (p, n, 3) with p = {parts} convex parts of "
                f"n = {points} points: make the body with objects.make or objects.load. For several bodies, pass a "
                "sequence",
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


def refusal(body: Body, scenario: Scenario) -> str | None:
    """Return the reason why a body cannot start in a scenario, or None if it can.

    Args:
        body: One body. The points of its hulls must span a volume.
        scenario: Scenario in which the body is to start.

    Returns:
        A sentence about the body, such as "it rests on no face, because ...", or None.
    """
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
    """Compute the collision hull of each body: vertices, edges and faces of its convex parts.

    Raises:
        BodyError: The points of a hull span no volume.
    """
    found = []
    for index, body in enumerate(bodies):
        try:
            found.append(contact.hull(np.asarray(body.hulls)))
        except ValueError as error:
            raise BodyError(index, str(error)) from error
    return found


def shapes(bodies: Sequence[Body], scenario: Scenario) -> Shape:
    """Compute the geometry of each body, which the scenario needs to draw random initial poses.

    Args:
        bodies: Bodies that `check_bodies` accepts.
        scenario: Scenario in which the bodies are to start.

    Returns:
        Arrays with a leading axis of bodies. Bodies can differ in the number of vertices and in the number of faces on
            which they can rest. Shorter arrays are padded to the longest.

    Raises:
        BodyError: A body cannot start in the scenario.
    """
    faces = [_faces(body) for body in bodies]
    for index, own in enumerate(faces):
        reason = _refusal(own, scenario)
        if reason is not None:
            raise BodyError(index, f"{reason}: leave this body out")
    coms = np.stack([np.asarray(body.shell_com)[None] for body in bodies])
    if scenario.by_contents:
        hidden = jax.vmap(scenario.hidden)(jax.random.split(jax.random.key(0), CONTENTS))
        contents = hidden.fill, hidden.shell_scale, hidden.up
        coms = np.stack([np.asarray(rigid_of_draws(body, *contents)[1]) for body in bodies])
    return Shape(
        points=_padded([np.asarray(body.hulls).reshape(-1, 3) for body in bodies], "edge"),
        rests=_padded([own.up for own in faces], "edge"),
        shares=_padded([own.share for own in faces], "constant"),
        coms=coms,
    )


def _padded(arrays: Sequence[np.ndarray], mode: Literal["edge", "constant"]) -> np.ndarray:
    """Stack arrays of different lengths, padded with their last row ("edge") or with 0 ("constant")."""
    size = max(map(len, arrays))
    rest = ((0, 0),) * (arrays[0].ndim - 1)
    return np.stack([np.pad(x, ((0, size - len(x)), *rest), mode) for x in arrays]).astype(np.float32)
