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
from sts_jax.objects.meshes import load
from sts_jax.objects.procedural import make
from sts_jax.objects.solids import fill_moments, hull_gap

__all__ = [
    "CATEGORIES",
    "FACE_CLASSES",
    "HULL_CLASSES",
    "NUM_FILLS",
    "TEXTURE_CLASSES",
    "Body",
    "fill_moments",
    "hull_gap",
    "load",
    "make",
    "mirror",
    "rigid",
    "stack",
]
