"""Datasets on disk: `collect` simulates, renders and writes them, and `load` reads them as arrays."""

from sts_jax.dataset.collecting import Collected, Progress, collect
from sts_jax.dataset.collection import Collection, class_names, make_bodies, split_objects
from sts_jax.dataset.loading import Dataset, Ends, Pairs, Views, load, reduced, reduced_images
from sts_jax.dataset.measurement import Measurement
from sts_jax.dataset.meshes import Meshes, mesh_classes, survey_meshes
from sts_jax.dataset.records import Images
from sts_jax.dataset.rendering import empty_frame, frames_per_call, render_uint8

__all__ = [
    "Collected",
    "Collection",
    "Dataset",
    "Ends",
    "Images",
    "Measurement",
    "Meshes",
    "Pairs",
    "Progress",
    "Views",
    "class_names",
    "collect",
    "empty_frame",
    "frames_per_call",
    "load",
    "make_bodies",
    "mesh_classes",
    "reduced",
    "reduced_images",
    "render_uint8",
    "split_objects",
    "survey_meshes",
]
