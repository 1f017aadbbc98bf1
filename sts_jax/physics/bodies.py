"""The bodies of a simulation: whether they can start in a scenario, and where."""

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

CONTENTS = 16  # draws of a body's contents by which a start may be chosen


class BodyError(ValueError):
    """One of several bodies cannot be simulated.

    Attributes:
        body: Its index.
    """

    def __init__(self, body: int, reason: str):
        super().__init__(f"body {body}: {reason}")
        self.body = body


def check_bodies(bodies: Sequence[Any]) -> None:
    """Raise an error unless all are bodies with finite values and a known number of hull points.

    Raises:
        TypeError: one is of another type.
        BodyError: one has bad values.
    """
    for i, body in enumerate(bodies):
        if not isinstance(body, Body):
            raise TypeError(
                f"body {i} is {body!r}, but it must be a Body: objects.make draws one, objects.load reads a mesh file. "
                "For several, pass a sequence of them"
            )
        known = body.hulls.ndim == 3 and body.hulls.shape[1] in objects.HULL_CLASSES
        if not known or body.hulls.shape[0] not in objects.PART_CLASSES:
            raise BodyError(
                i,
                f"hulls has shape {body.hulls.shape}, but it must be (p, n, 3) with p in {objects.PART_CLASSES} and "
                f"n in {objects.HULL_CLASSES}",
            )
        if not np.isfinite(body.hulls).all():
            raise BodyError(i, "hulls has a non-finite vertex, but all must be finite")
        if not (np.isfinite(body.shell_mass) and body.shell_mass > 0):
            raise BodyError(i, f"shell_mass is {body.shell_mass} kg, but it must be > 0 and finite: give load a mass")
        try:
            body.check()
        except ValueError as error:
            raise BodyError(i, str(error)) from error


def refusal(body: Body, scenario: Scenario) -> str | None:
    """The reason why an object cannot start in a scenario, or None if it can.

    Args:
        body: one object, whose hull spans a volume.
        scenario: scenario of the start.
    """
    return _refusal(_faces(body), scenario)


def _refusal(faces: StableFaces, scenario: Scenario) -> str | None:
    if not len(faces.up):
        return "it rests on no face, because its centre of mass lies outside its hull or at the edge of every face"
    if scenario.must_stand and faces.up[:, 2].max() < math.cos(UPRIGHT):
        return f"it does not stand upright (+z up), as {type(scenario).__name__} needs"
    return None


def _faces(body: Body) -> StableFaces:
    """The faces on which an empty body can rest."""
    points = np.asarray(body.hulls, np.float64).reshape(-1, 3)
    return StableFaces(*objects.rest_poses(points, np.asarray(body.shell_com, np.float64)))


def hulls(bodies: Sequence[Body]) -> list[Hull]:
    """The collision hulls of the bodies.

    Raises:
        BodyError: a hull spans no volume.
    """
    found = []
    for index, body in enumerate(bodies):
        try:
            found.append(contact.hull(np.asarray(body.hulls)))
        except ValueError as error:
            raise BodyError(index, str(error)) from error
    return found


def shapes(bodies: Sequence[Body], scenario: Scenario) -> Shape:
    """The properties that determine the starts of each body, padded to a common size.

    Raises:
        BodyError: a body cannot start in the scenario.
    """
    faces = [_faces(body) for body in bodies]
    for index, own in enumerate(faces):
        reason = _refusal(own, scenario)
        if reason is not None:
            raise BodyError(index, f"{reason}: leave it out")
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
    """Arrays of different lengths as one array, padded with their last row or with 0."""
    size = max(map(len, arrays))
    rest = ((0, 0),) * (arrays[0].ndim - 1)
    return np.stack([np.pad(x, ((0, size - len(x)), *rest), mode) for x in arrays]).astype(np.float32)
