"""Procedural objects: the registry of families, and `make`, which generates an object of a family from a random key."""

import dataclasses
import importlib
from collections.abc import Callable

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from sts_jax._checked import check_key
from sts_jax.objects.assembly import CONTENTS, assemble
from sts_jax.objects.body import CATEGORIES, FACE_CLASSES, PAD, Body
from sts_jax.objects.checks import ROUNDING, limits
from sts_jax.objects.families import bottle, camera, cutlery, mouse, scissors, watch, webcam
from sts_jax.objects.shapes import Part


@dataclasses.dataclass(frozen=True)
class Family:
    """A class of procedural objects.

    Args:
        name: Name of the class. The category of a body is its index in CATEGORIES, or -1 if CATEGORIES lacks it.
        seed: Whole number >= 0 that is combined with the key of `make`, so that families draw different numbers.
        parts: Function that draws the dimensions and colours of an object from a `numpy.random.Generator` and returns
            its parts in millimetres, with +z up in its usual pose. Equal generators must lead to equal parts. The
            object collides as the convex hull of all parts.
    """

    name: str
    seed: int
    parts: Callable[[np.random.Generator], list[Part]]


# Seeds never change, so that equal keys lead to equal objects in every version.
_PARTS = (
    bottle.parts,
    camera.parts,
    webcam.parts,
    mouse.parts,
    scissors.parts,
    cutlery.fork,
    cutlery.spoon,
    watch.parts,
)
FAMILIES = {name: Family(name, seed, parts) for seed, (name, parts) in enumerate(zip(CATEGORIES, _PARTS, strict=True))}


def find_family(category: str) -> Family:
    """Return the family of a category: one of CATEGORIES, or "module:NAME" for a `Family` of your own.

    The module is imported, and its variable NAME must hold the family. That of a notebook or script is `__main__`.
    """
    if category in FAMILIES:
        return FAMILIES[category]
    module, colon, name = category.partition(":")
    if not (module and colon and name):
        raise ValueError(f"category is {category!r}, but it must be one of {', '.join(FAMILIES)}, or 'module:NAME'")
    try:
        family = getattr(importlib.import_module(module), name, None)
    except ModuleNotFoundError as error:
        raise ValueError(
            f"category is {category!r}, but the module {module} cannot be imported ({error}): install it, or start "
            "Python in the folder that contains it"
        ) from error
    if not isinstance(family, Family):
        fault = "does not exist" if family is None else f"is of type {type(family).__name__}"
        raise ValueError(
            f"category is {category!r}, but the variable {name} of {module} {fault}: assign a Family to it"
        )
    return family


def make(key: PRNGKeyArray, category: str | Family, *, pad: float = PAD) -> Body:
    """Generate a random object of a category: a `Family` or a name for `find_family`. Equal keys lead to equal objects.

    Its +z axis points up in its usual pose. The longest side is 50 to 130 mm for the CATEGORIES. That of a `Family` may
    be 5 to 150 mm on the paper's pad, and 1/30 to 1 times the width `pad` (m) of a smaller one.
    """
    check_key(key)
    family = find_family(category) if isinstance(category, str) else category
    words = np.asarray(jax.random.key_data(key)).ravel()
    parts = family.parts(np.random.default_rng([*(int(word) for word in words), family.seed]))
    try:
        _check(parts, pad)
        return _assembled(parts, CATEGORIES.index(family.name) if family.name in CATEGORIES else -1)
    except ValueError as error:
        raise ValueError(f"family {family.name}: {error}") from error


def _assembled(parts: list[Part], category: int) -> Body:
    first = np.cumsum([0, *(len(part.vertices) for part in parts)])
    vertices = np.concatenate([part.vertices for part in parts]) * 1e-3
    faces = np.concatenate([part.faces + offset for part, offset in zip(parts, first[:-1], strict=True)])
    colors = np.concatenate([part.colors for part in parts])
    density = np.concatenate([np.full(len(part.faces), part.density) for part in parts])
    inner = [part for part in parts if part.interior]
    interior = (inner[0].vertices * 1e-3, inner[0].faces) if inner else None
    return assemble(
        vertices,
        faces,
        np.repeat(colors[:, None], 3, axis=1),
        density=density,
        interior=interior,
        contents_density=CONTENTS if inner else 0.0,
        category=category,
    )


def _check(parts: list[Part], pad: float) -> None:
    """Raise a ValueError unless the parts form an object of an allowed size."""
    if not parts:
        raise ValueError("parts() must return at least one Part, got none")
    inner = sum(part.interior for part in parts)
    if inner > 1:
        raise ValueError(f"at most one part can have interior=True, got {inner}")
    points, faces = np.concatenate([part.vertices for part in parts]), sum(len(part.faces) for part in parts)
    if max(len(points), faces) > FACE_CLASSES[-1]:
        raise ValueError(
            f"the parts of one object have {faces:,} faces and {len(points):,} vertices, but at most "
            f"{FACE_CLASSES[-1]:,} of each are allowed: use fewer points in outlines and paths"
        )
    if not np.isfinite(points).all():
        raise ValueError(f"all vertices must be finite, got {points[~np.isfinite(points)][0]}")
    longest = float(np.ptp(points, axis=0).max())
    low, high = (1e3 * length for length in limits(pad))
    if not low * (1 - ROUNDING) <= longest <= high * (1 + ROUNDING):
        raise ValueError(
            f"the longest side must be {low:g} to {high:g} mm, got {longest:.3g} mm: give the parts in "
            "millimetres, or scale them to a length with shapes.scaled"
        )
