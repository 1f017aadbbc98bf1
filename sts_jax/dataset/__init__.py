"""Datasets on disk: `collect` simulates, renders and writes them, and `load` reads them as arrays."""

from sts_jax.dataset.collecting import Collected as Collected
from sts_jax.dataset.collecting import Progress as Progress
from sts_jax.dataset.collecting import collect as collect
from sts_jax.dataset.collection import LEAST as LEAST
from sts_jax.dataset.collection import Collection as Collection
from sts_jax.dataset.collection import as_json as as_json
from sts_jax.dataset.collection import class_names as class_names
from sts_jax.dataset.collection import make_bodies as make_bodies
from sts_jax.dataset.collection import split_objects as split_objects
from sts_jax.dataset.items import Items as Items
from sts_jax.dataset.loading import Dataset as Dataset
from sts_jax.dataset.loading import Ends as Ends
from sts_jax.dataset.loading import Pairs as Pairs
from sts_jax.dataset.loading import Views as Views
from sts_jax.dataset.loading import load as load
from sts_jax.dataset.loading import reduced as reduced
from sts_jax.dataset.loading import reduced_images as reduced_images
from sts_jax.dataset.measurement import Measurement as Measurement
from sts_jax.dataset.meshes import Meshes as Meshes
from sts_jax.dataset.meshes import survey_meshes as survey_meshes
from sts_jax.dataset.records import Images as Images
from sts_jax.dataset.rendering import empty_frame as empty_frame
from sts_jax.dataset.rendering import frames_per_call as frames_per_call
from sts_jax.dataset.rendering import render_uint8 as render_uint8
