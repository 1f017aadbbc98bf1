"""Objects: what falls on the sensor, made from a key or loaded from a mesh file."""

from .body import CATEGORIES, FACE_CLASSES, HULL_CLASSES, NUM_FILLS, TEXTURE_CLASSES, Body, rigid, stack
from .meshes import load
from .procedural import make
from .solids import fill_moments, hull_gap

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
    "rigid",
    "stack",
]
