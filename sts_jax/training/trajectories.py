"""Training arrays and models from the first and last moments of trajectories."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import UInt8

from sts_jax import mvae, optics, physics, statespace
from sts_jax.dataset import Ends, Pairs, Views, reduced
from sts_jax.sensor import Sensor
from sts_jax.training.arrays import Arrays
from sts_jax.training.preprocess import Preprocessing

SOME = 512  # items that are encoded at once


def moments(
    pairs: Pairs, modalities: tuple[str, ...], preprocessing: Preprocessing, blank: np.ndarray
) -> tuple[Arrays, Preprocessing]:
    """Make training arrays, with first moments as inputs and last moments as targets.

    Args:
        pairs: trajectories, from `dataset.Dataset.pairs`.
        modalities: modalities of the model, some of `visual`, `tactile` and `pose`.
        preprocessing: how measurements are encoded for the networks.
        blank: the tactile image of the untouched sensor, uint8 `(height, width, 3)`, from `dataset.empty_frame`.

    Returns:
        The arrays, and the preprocessing with `absent` set: touch is not an input if no first moment has a contact.
    """
    code = np.asarray(preprocessing.encode_pose(jnp.asarray(pairs.pose)))
    found = {"visual": pairs.visual, "tactile": pairs.tactile, "pose": code}
    condition = np.asarray(preprocessing.encode_condition(jnp.asarray(pairs.condition)))
    return _moments(found, modalities, preprocessing, blank, condition if condition.shape[1] else None)


def image_moments(
    visual: UInt8[np.ndarray, "n 2 h w 3"],
    tactile: UInt8[np.ndarray, "n 2 h w 3"],
    modalities: tuple[str, ...],
    preprocessing: Preprocessing,
    blank: UInt8[np.ndarray, "h w 3"],
) -> tuple[Arrays, Preprocessing]:
    """`moments` of images without poses, such as those of a real sensor (`hardware.moments`).

    Args:
        visual: first and last images.
        tactile: first and last images.
        modalities: modalities of the model, some of `visual` and `tactile`.
        preprocessing: its criterion for a touch decides which first touches are inputs, see `touch_of_noisy_images`.
        blank: the tactile image of the untouched sensor.

    Raises:
        ValueError: another modality is asked for, or the images have not all the shape of the preprocessing.
    """
    found, shape = {"visual": visual, "tactile": tactile}, (2, *preprocessing.resolution, 3)
    if not modalities or not set(modalities) <= set(found):
        raise ValueError(f"modalities must be one or both of {', '.join(found)}, got {modalities}")
    for name, images in found.items():
        if images.dtype != np.uint8 or images.shape != (len(visual), *shape) or not len(images):
            raise ValueError(
                f"{name} is {images.dtype} of shape {images.shape}, but it must be uint8 of shape (n, "
                f"{', '.join(map(str, shape))}) with the same n >= 1 for both streams"
            )
    return _moments(found, modalities, preprocessing, blank, None)


def _moments(
    found: dict[str, np.ndarray],
    modalities: tuple[str, ...],
    preprocessing: Preprocessing,
    blank: np.ndarray,
    condition: np.ndarray | None,
) -> tuple[Arrays, Preprocessing]:
    touched = _touched(found["tactile"], preprocessing, blank)
    absent = ("tactile",) if "tactile" in modalities and not touched.any() else ()
    arrays = Arrays(
        inputs={name: np.ascontiguousarray(found[name][:, 0]) for name in modalities if name not in absent},
        targets={name: np.ascontiguousarray(found[name][:, 1]) for name in modalities},
        present={"tactile": touched} if "tactile" in modalities and not absent else {},
        condition=condition,
    )
    return arrays, dataclasses.replace(preprocessing, absent=absent)


def paper_model(modalities: tuple[str, ...], preprocessing: Preprocessing) -> mvae.Config:
    """The paper's networks for some modalities. The weight lambda is 1 for images and 1000 for the pose."""
    pose = mvae.Modality("pose", "vector", (preprocessing.pose_size,), weight=1000.0)
    shape = (*preprocessing.resolution, 3)
    images = {name: mvae.Modality(name, "image", shape, start=0.7) for name in ("visual", "tactile")}
    kept = tuple({**images, "pose": pose}[name] for name in modalities)
    return mvae.Config(kept, condition=len(preprocessing.condition_scale))


def state_moments(
    pairs: Pairs,
    model: statespace.Config,
    scenario: physics.Scenario,
    preprocessing: Preprocessing,
    empty: dict[str, np.ndarray],
    *,
    views: Views | None = None,
    falls: Ends | None = None,
) -> Arrays:
    """Make the arrays that train a state-space model.

    Args:
        pairs: trajectories, from `dataset.Dataset.pairs`, with images of the model's `input_size`.
        model: from `state_model`.
        scenario: the scenario of the trajectories.
        preprocessing: how measurements are encoded for the networks.
        empty: the images of the untouched sensor, uint8 `(size, size, 3)`, from `dataset.empty_frame`.
        views: pictures at further starts, from `dataset.Dataset.views`, used if the model takes `visual`.
        falls: further trajectories without images, from `dataset.Dataset.ends`.

    Raises:
        ValueError: a trajectory has an outcome that the scenario does not have.
    """
    ends: list[Pairs | Ends] = [pairs] if falls is None else [pairs, falls]
    outcome, *other_outcomes = (_outcome_index(own.outcome, scenario) for own in ends)
    condition, *other_conditions = (np.asarray(preprocessing.encode_condition(jnp.asarray(x.condition))) for x in ends)
    code = np.asarray(preprocessing.encode_pose(jnp.asarray(pairs.pose)))
    last = reduced(pairs._replace(visual=pairs.visual[:, 1:], tactile=pairs.tactile[:, 1:]), model.image_size)
    inputs = {"visual": pairs.visual[:, 0], "tactile": pairs.tactile[:, 0], "pose": code[:, 0]}
    touched = {"tactile": _touched(pairs.tactile, preprocessing, empty["tactile"])} if "tactile" in model.inputs else {}
    further: dict[str, dict[str, np.ndarray]] = {"views": {}, "falls": {}}
    if views is not None and len(views.pose) and "visual" in model.inputs:
        further["views"] = {
            "visual": views.visual,
            "state": state_codes(preprocessing, views.pose, views.support, views.mass, views.com),
        }
    if falls is not None and len(falls.pose):
        further["falls"] = {
            "state": state_codes(preprocessing, falls.pose[:, 0], falls.support, falls.mass, falls.com),
            "pose": np.asarray(preprocessing.encode_pose(jnp.asarray(falls.pose[:, 1]))),
            "outcome": other_outcomes[0],
        }
        if condition.shape[1]:
            further["falls"]["condition"] = other_conditions[0]
    return Arrays(
        inputs={name: np.ascontiguousarray(inputs[name]) for name in model.inputs},
        targets={
            "visual": last.visual[:, 0],
            "tactile": last.tactile[:, 0],
            "state": state_codes(preprocessing, pairs.pose[:, 0], pairs.support, pairs.mass, pairs.com),
            "pose": code[:, 1],
            "outcome": outcome,
        },
        present=touched,
        condition=condition if condition.shape[1] else None,
        empty=empty,
        **further,
    )


def _outcome_index(outcome: np.ndarray, scenario: physics.Scenario) -> np.ndarray:
    numbers = np.array([int(known) for known in scenario.outcomes])
    if not np.isin(outcome, numbers).all():
        raise ValueError(
            f"pairs have the outcomes {np.unique(outcome).tolist()}, but {type(scenario).__name__} has the outcomes "
            f"{numbers.tolist()}: give the scenario of the collection"
        )
    return (outcome[:, None] == numbers).argmax(1).astype(np.int32)


def state_codes(
    preprocessing: Preprocessing, pose: np.ndarray, support: np.ndarray, mass: np.ndarray, com: np.ndarray
) -> np.ndarray:
    """Encode true states as codes (n, code) of a state-space model, see `statespace.encode`.

    Args:
        preprocessing: the preprocessing of the model.
        pose: (n, 7), m and unit quaternion.
        support: (n, 128), m. This and the following arguments are as in `dataset.Pairs`.
        mass: (n,), kg.
        com: (n, 3), m, mesh frame.
    """
    encode = jax.jit(statespace.encode)
    parts = []
    for start in range(0, len(pose), SOME):  # bounds the memory
        rows = slice(start, start + SOME)
        code = preprocessing.encode_pose(jnp.asarray(pose[rows]))
        parts.append(np.asarray(encode(code, support[rows], mass[rows], com[rows])))
    return np.concatenate(parts)


def state_model(
    pairs: Pairs,
    sensor: Sensor,
    scenario: physics.Scenario,
    preprocessing: Preprocessing,
    empty: dict[str, np.ndarray],
    *,
    image_size: int = 64,
) -> tuple[statespace.Config, Preprocessing]:
    """A state-space model of the size that the experiments use, and the preprocessing with `absent` set.

    Touch is not an input if no first moment has a contact. The other arguments are those of `state_moments`, and the
    sensor.

    Args:
        image_size: side of the predicted images, pixels.

    Raises:
        ValueError: the images are not square, or are cropped (the model finds the object itself), or their side is no
            multiple of `image_size`.
    """
    height, width = preprocessing.resolution
    if height != width or preprocessing.crop:
        raise ValueError(
            f"resolution is {preprocessing.resolution} and crop is {preprocessing.crop}, but a state-space model "
            "takes square images of the whole view: give a preprocessing with resolution=(n, n) and crop=False"
        )
    absent = () if _touched(pairs.tactile, preprocessing, empty["tactile"]).any() else ("tactile",)
    model = statespace.Config(
        inputs=tuple(name for name in statespace.INPUTS if name not in absent),
        outcomes=len(scenario.outcomes),
        condition=len(preprocessing.condition_scale),
        vectors=scenario.vectors if scenario.quantities else 1,
        input_size=height,
        image_size=image_size,
        camera_distance=float(sensor.camera.distance),
        view=float(optics.full_window(sensor.camera, preprocessing.resolution)[2]),
        position_scale=preprocessing.position_scale,
    )
    return model, dataclasses.replace(preprocessing, absent=absent)


def _touched(tactile: np.ndarray, preprocessing: Preprocessing, blank: np.ndarray) -> np.ndarray:
    """Whether the first tactile image of each trajectory shows a contact. Images are split to bound the memory."""
    parts = np.array_split(tactile[:, 0], max(len(tactile) // 256, 1))
    return np.concatenate(
        [
            np.asarray(preprocessing.touched(jnp.asarray(part / 255, jnp.float32), jnp.asarray(blank / 255)))
            for part in parts
        ]
    )
