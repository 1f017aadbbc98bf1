"""From a collection's first and last moments to the arrays and the model of the paper's task."""

import dataclasses

import jax.numpy as jnp
import numpy as np

from sts_jax import mvae
from sts_jax.dataset import Pairs
from sts_jax.training.preprocess import Preprocessing
from sts_jax.training.train import Arrays


def moments(
    pairs: Pairs, modalities: tuple[str, ...], preprocessing: Preprocessing, blank: np.ndarray
) -> tuple[Arrays, Preprocessing]:
    """The first moments as inputs and the last ones as targets.

    Args:
        pairs: trajectories, from `dataset.Dataset.pairs`.
        modalities: of the model: some of `visual`, `tactile`, `pose`.
        preprocessing: how the networks see measurements.
        blank: the tactile image of the untouched sensor, uint8 `(height, width, 3)`, from `dataset.empty_frame`.

    Returns:
        The arrays; and the preprocessing with `absent` set: touch is no input where no first moment has a contact.
    """
    code = np.asarray(preprocessing.encode_pose(jnp.asarray(pairs.pose)))
    found = {"visual": pairs.visual, "tactile": pairs.tactile, "pose": code}
    condition = np.asarray(preprocessing.encode_condition(jnp.asarray(pairs.condition)))
    touched = np.asarray(
        preprocessing.touched(jnp.asarray(pairs.tactile[:, 0] / 255, jnp.float32), jnp.asarray(blank / 255))
    )
    absent = ("tactile",) if "tactile" in modalities and not touched.any() else ()
    arrays = Arrays(
        inputs={name: np.ascontiguousarray(found[name][:, 0]) for name in modalities if name not in absent},
        targets={name: np.ascontiguousarray(found[name][:, 1]) for name in modalities},
        present={"tactile": touched} if "tactile" in modalities and not absent else {},
        condition=condition if condition.shape[1] else None,
    )
    return arrays, dataclasses.replace(preprocessing, absent=absent)


def paper_model(modalities: tuple[str, ...], preprocessing: Preprocessing) -> mvae.Config:
    """The paper's networks for some modalities; the weight lambda is 1 for images and 1000 for the pose."""
    pose = mvae.Modality("pose", "vector", (preprocessing.pose_size,), weight=1000.0)
    shape = (*preprocessing.resolution, 3)
    images = {name: mvae.Modality(name, "image", shape, start=0.7) for name in ("visual", "tactile")}
    kept = tuple({**images, "pose": pose}[name] for name in modalities)
    return mvae.Config(kept, condition=len(preprocessing.condition_scale))
