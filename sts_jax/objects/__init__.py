"""Objects: what falls on the sensor, made from a key or loaded from a mesh file."""

from sts_jax.objects.body import (
    CATEGORIES,
    FACE_CLASSES,
    HULL_CLASSES,
    NUM_FILLS,
    TEXTURE_CLASSES,
    Body,
    mirror,
    rigid,
    stack,
)
from sts_jax.objects.libraries import Entry, Item, Library, bodies, describe, library, read, survey
from sts_jax.objects.meshes import load
from sts_jax.objects.procedural import make
from sts_jax.objects.solids import convex_parts, fill_moments, hull_gap, surface_gaps

__all__ = [
    "CATEGORIES",
    "FACE_CLASSES",
    "HULL_CLASSES",
    "NUM_FILLS",
    "TEXTURE_CLASSES",
    "Body",
    "Entry",
    "Item",
    "Library",
    "bodies",
    "convex_parts",
    "describe",
    "fill_moments",
    "hull_gap",
    "library",
    "load",
    "make",
    "mirror",
    "read",
    "rigid",
    "stack",
    "surface_gaps",
    "survey",
]
