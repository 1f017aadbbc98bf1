"""Rigid objects for the simulation and the renderer, generated from a random key or loaded from mesh files."""

from sts_jax.objects.body import (
    CATEGORIES,
    FACE_CLASSES,
    HULL_CLASSES,
    PART_CLASSES,
    TEXTURE_CLASSES,
    Body,
    fill_moments,
    mirror,
    rigid,
    stack,
)
from sts_jax.objects.hulls import DIRECTIONS, lattice, rest_poses, support
from sts_jax.objects.items import Entry, Item, Library
from sts_jax.objects.libraries import HOLLOW, bodies, facts, library, read, survey
from sts_jax.objects.meshes import load
from sts_jax.objects.parts import decompose, gaps
from sts_jax.objects.procedural import Family, find_family, make

__all__ = [
    "CATEGORIES",
    "DIRECTIONS",
    "FACE_CLASSES",
    "HOLLOW",
    "HULL_CLASSES",
    "PART_CLASSES",
    "TEXTURE_CLASSES",
    "Body",
    "Entry",
    "Family",
    "Item",
    "Library",
    "bodies",
    "decompose",
    "facts",
    "fill_moments",
    "find_family",
    "gaps",
    "lattice",
    "library",
    "load",
    "make",
    "mirror",
    "read",
    "rest_poses",
    "rigid",
    "stack",
    "support",
    "survey",
]
