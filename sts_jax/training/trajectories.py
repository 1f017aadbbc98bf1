"""Training arrays from trajectories, and the model configurations that fit these arrays."""

import dataclasses
import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8

from sts_jax import mvae, optics, physics, statespace
from sts_jax._checked import checked
from sts_jax.dataset import Ends, Measurement, Pairs, Views, reduced_images
from sts_jax.sensor import Sensor
from sts_jax.training.arrays import Arrays
from sts_jax.training.preprocess import Preprocessing

_CHUNK = 512  # number of items that are encoded at once


def frame_arrays(
    pairs: Pairs,
    modalities: tuple[str, ...],
    preprocessing: Preprocessing,
    blank: np.ndarray,
    *,
    measurements: Sequence[Measurement] = (),
) -> tuple[Arrays, Preprocessing]:
    """Make the training arrays of an `mvae` model: inputs from first frames, targets from last frames.

    Args:
        pairs: From `dataset.Dataset.pairs`.
        modalities: Modalities of the model, some of `visual`, `tactile` and `pose`.
        preprocessing: Encodes poses and conditions, and detects contacts in tactile images. A trajectory without a
            contact in its first frame gives a sample without the input `tactile`.
        blank: Tactile image of the empty sensor, uint8 `(height, width, 3)`, from `dataset.empty_frame`.
        measurements: Further modalities of the model. `pairs.measurements` must have their values.

    Returns:
        The arrays, and the preprocessing with new values of `absent` (the modalities that no first frame has, which
        `arrays.inputs` omits) and `scales` (of the measurements that are vectors).
    """
    further = tuple(measurement.name for measurement in measurements)
    lacking = sorted(set(further) - set(pairs.measurements))
    if lacking:
        raise ValueError(
            f"pairs.measurements lacks {', '.join(lacking)}: pass the same `measurements` to Dataset.pairs"
        )
    scales = tuple((m.name, float(m.scale)) for m in measurements if not m.is_image)
    preprocessing = dataclasses.replace(preprocessing, scales=scales)
    code = np.asarray(_pose_codes(preprocessing, pairs.pose))
    frames = {"visual": pairs.visual, "tactile": pairs.tactile, "pose": code}
    for m in measurements:
        values = pairs.measurements[m.name]
        frames[m.name] = values if m.is_image else np.asarray(preprocessing.encode(m.name, jnp.asarray(values)))
    condition = np.asarray(preprocessing.encode_condition(jnp.asarray(pairs.condition)))
    return _arrays(frames, modalities, preprocessing, blank, condition if condition.shape[1] else None, further)


@checked
def image_arrays(
    visual: UInt8[np.ndarray, "n 2 h w 3"],
    tactile: UInt8[np.ndarray, "n 2 h w 3"],
    modalities: tuple[str, ...],
    preprocessing: Preprocessing,
    blank: UInt8[np.ndarray, "h w 3"],
) -> tuple[Arrays, Preprocessing]:
    """Make the training arrays of an `mvae` model from images without poses, as from a real sensor.

    Args:
        visual: First and last visual image of each trajectory, for example from `hardware.Recordings.images`.
        tactile: First and last tactile image of each trajectory.
        modalities: Modalities of the model, one or both of `visual` and `tactile`.
        preprocessing: Detects contacts in tactile images. For images of a camera, from `touch_of_noisy_images`.
        blank: Tactile image of the empty sensor.

    Returns:
        The arrays, and the preprocessing with a new value of `absent`, as from `frame_arrays`.
    """
    if not modalities or not set(modalities) <= {"visual", "tactile"}:
        raise ValueError(f"modalities must be one or both of 'visual' and 'tactile', got {modalities}")
    if blank.shape[:2] != preprocessing.resolution:
        raise ValueError(
            f"the images have {blank.shape[:2]} pixels, but preprocessing.resolution is {preprocessing.resolution}: "
            "resize the images"
        )
    return _arrays({"visual": visual, "tactile": tactile}, modalities, preprocessing, blank, None)


def _arrays(
    frames: dict[str, np.ndarray],
    modalities: tuple[str, ...],
    preprocessing: Preprocessing,
    blank: np.ndarray,
    condition: np.ndarray | None,
    further: tuple[str, ...] = (),
) -> tuple[Arrays, Preprocessing]:
    """Make the training arrays of an `mvae` model from encoded first and last frames by modality."""
    # NaN marks frames in which a further modality was not measured.
    measured = {name: ~np.isnan(frames[name]).reshape(*frames[name].shape[:2], -1).any(-1) for name in further}
    present = {name: mask[:, 0] for name, mask in measured.items() if not mask[:, 0].all()}
    if "tactile" in modalities:
        present["tactile"] = _touched(frames["tactile"], preprocessing, blank)
    absent = tuple(name for name, mask in present.items() if not mask.any())
    names = (*modalities, *further)
    arrays = Arrays(
        inputs={name: np.ascontiguousarray(frames[name][:, 0]) for name in names if name not in absent},
        targets={name: np.ascontiguousarray(frames[name][:, 1]) for name in names},
        present={name: mask for name, mask in present.items() if name not in absent},
        target_present={name: mask[:, 1] for name, mask in measured.items() if not mask[:, 1].all()},
        condition=condition,
    )
    return arrays, dataclasses.replace(preprocessing, absent=absent)


def paper_model(
    modalities: tuple[str, ...], preprocessing: Preprocessing, *, measurements: Sequence[Measurement] = ()
) -> mvae.Config:
    """Make the configuration of the networks in the See-Through-your-Skin paper.

    The weight of the reconstruction error is 1 for images, 1000 for the pose, and `Measurement.weight` otherwise.

    Args:
        modalities: Modalities of the model, some of `visual`, `tactile` and `pose`.
        preprocessing: Preprocessing of the training arrays.
        measurements: Further modalities of the model.
    """
    shape = (*preprocessing.resolution, 3)
    standard = {name: mvae.Modality(name, "image", shape, start=0.7) for name in ("visual", "tactile")}
    standard["pose"] = mvae.Modality("pose", "vector", (preprocessing.pose_size,), weight=1000.0)
    if not set(modalities) <= set(standard):
        raise ValueError(
            f"modalities may contain only {', '.join(map(repr, standard))}, got {modalities}: pass further modalities "
            "as measurements"
        )
    further = [
        mvae.Modality(m.name, "image" if m.is_image else "vector", m.shape, weight=float(m.weight))
        for m in measurements
    ]
    return mvae.Config(
        tuple([standard[name] for name in modalities] + further), condition=len(preprocessing.condition_scale)
    )


def state_arrays(
    pairs: Pairs,
    model: statespace.Config,
    scenario: physics.Scenario,
    preprocessing: Preprocessing,
    empty: dict[str, np.ndarray],
    *,
    views: Views | None = None,
    falls: Ends | None = None,
) -> Arrays:
    """Make the training arrays of a state-space model.

    Args:
        pairs: From `dataset.Dataset.pairs`, with images of `model.input_size` pixels on each side.
        model: Configuration of the model, from `state_model`.
        scenario: Scenario of the trajectories.
        preprocessing: Encodes poses and conditions, and detects contacts in tactile images.
        empty: `visual` and `tactile` image of the empty sensor, uint8 `(input_size, input_size, 3)`, from
            `dataset.empty_frame`.
        views: From `dataset.Dataset.views`. They are used only if `visual` is an input of the model.
        falls: Further trajectories without images, from `dataset.Dataset.ends`.
    """
    ends: list[Pairs | Ends] = [pairs] if falls is None else [pairs, falls]
    outcome, *other_outcomes = (_outcome_index(x.outcome, scenario) for x in ends)
    condition, *other_conditions = (np.asarray(preprocessing.encode_condition(jnp.asarray(x.condition))) for x in ends)
    code = np.asarray(_pose_codes(preprocessing, pairs.pose))
    last = reduced_images({"visual": pairs.visual[:, 1], "tactile": pairs.tactile[:, 1]}, model.image_size)
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
            "pose": np.asarray(_pose_codes(preprocessing, falls.pose[:, 1])),
            "outcome": other_outcomes[0],
        }
        if condition.shape[1]:
            further["falls"]["condition"] = other_conditions[0]
    return Arrays(
        inputs={name: np.ascontiguousarray(inputs[name]) for name in model.inputs},
        targets={
            **last,
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
    """Convert the numbers of outcomes to indices into `scenario.outcomes`."""
    numbers = np.array([int(outcome) for outcome in scenario.outcomes])
    if not np.isin(outcome, numbers).all():
        raise ValueError(
            f"the trajectories have the outcomes {np.unique(outcome).tolist()}, but the scenario "
            f"{type(scenario).__name__} has the outcomes {numbers.tolist()}: give the scenario of the dataset"
        )
    return (outcome[:, None] == numbers).argmax(1).astype(np.int32)


def state_codes(
    preprocessing: Preprocessing, pose: np.ndarray, support: np.ndarray, mass: np.ndarray, com: np.ndarray
) -> np.ndarray:
    """Encode the true states of n objects as state codes `(n, code)`.

    Args:
        pose: Poses `(n, 7)`.
        support: Support functions of the convex hulls for `objects.DIRECTIONS`, `(n, 128)` (m).
        mass: Masses, `(n,)` (kg).
        com: Centres of mass in the mesh frame, `(n, 3)` (m).
    """
    encode = jax.jit(statespace.encode)
    parts = []
    size = min(_CHUNK, len(pose))
    for start in range(0, len(pose), max(size, 1)):  # bounds the memory
        # The last part is filled up with copies of the last object, because another size would compile anew.
        rows = np.minimum(np.arange(start, start + size), len(pose) - 1)
        code = _pose_codes(preprocessing, pose[rows])
        parts.append(np.asarray(encode(code, support[rows], mass[rows], com[rows])))
    return np.concatenate(parts)[: len(pose)]


@functools.partial(jax.jit, static_argnums=0)
def _pose_codes(preprocessing: Preprocessing, pose: Float[Array | np.ndarray, "*n 7"]) -> Float[Array, "*n code"]:
    """`Preprocessing.encode_pose`, compiled as one program."""
    return preprocessing.encode_pose(jnp.asarray(pose))


def state_model(
    pairs: Pairs,
    sensor: Sensor,
    scenario: physics.Scenario,
    preprocessing: Preprocessing,
    empty: dict[str, np.ndarray],
    *,
    image_size: int = 64,
) -> tuple[statespace.Config, Preprocessing]:
    """Make the configuration of a state-space model with the network sizes of the experiments.

    Args:
        pairs: First and last frames of the training trajectories, from `dataset.Dataset.pairs`.
        sensor: Sensor of the images.
        scenario: Scenario of the trajectories.
        preprocessing: Preprocessing of the trajectories. Its images must be square and show the whole view.
        empty: `visual` and `tactile` image of the empty sensor, uint8, from `dataset.empty_frame`.
        image_size: Side of the predicted images (pixels). It must divide the side of the input images.

    Returns:
        The configuration, and the preprocessing with a new value of `absent`, as from `frame_arrays`.
    """
    height, width = preprocessing.resolution
    if height != width or preprocessing.crop:
        raise ValueError(
            "a state-space model needs a preprocessing with resolution=(n, n) and crop=False, got resolution="
            f"{preprocessing.resolution} and crop={preprocessing.crop}"
        )
    absent = () if _touched(pairs.tactile, preprocessing, empty["tactile"]).any() else ("tactile",)
    model = statespace.Config(
        inputs=tuple(name for name in statespace.INPUTS if name not in absent),
        outcomes=len(scenario.outcomes),
        outcome_names=tuple(scenario.named(int(outcome)) for outcome in scenario.outcomes),
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
    """Return whether the first tactile image of each trajectory shows a contact."""
    # The images are processed in parts to bound the memory.
    parts = np.array_split(tactile[:, 0], max(len(tactile) // 256, 1))
    return np.concatenate([np.asarray(_contacts(preprocessing, part, blank)) for part in parts])


@functools.partial(jax.jit, static_argnums=0)
def _contacts(
    preprocessing: Preprocessing,
    tactile: UInt8[Array | np.ndarray, "n h w 3"],
    blank: UInt8[Array | np.ndarray, "h w 3"],
) -> Bool[Array, "n"]:
    """`Preprocessing.touched` for uint8 images, compiled as one program."""
    return preprocessing.touched(jnp.asarray(tactile, jnp.float32) / 255, jnp.asarray(blank, jnp.float32) / 255)


@checked
def shifted(
    images: UInt8[np.ndarray, "n 2 h w 3"], empty: UInt8[np.ndarray, "h w 3"], shifts: Int[np.ndarray, "n 2"]
) -> UInt8[np.ndarray, "n 2 h w 3"]:
    """Shift the images of trajectories, as if the objects were at other places on a level pad.

    The difference from the image of the empty pad is shifted, so that the light on the pad stays in place. The result
    is exact for points on the pad under distant lights, except for the vignetting of visual images. For a point at the
    height z above the pad, the shift is too large by the factor 1 + z / d, where d is the distance from the camera to
    the pad. What the border of the image cuts off is missing after the shift, too.

    Args:
        images: First and last image of each of n trajectories, all visual or all tactile.
        empty: Image of the empty pad, visual or tactile like `images`.
        shifts: Rows and columns by which each trajectory is shifted (pixels), to larger indices if positive. Its visual
            and its tactile images need the same shift.
    """
    size = images.shape[2:4]
    if (np.abs(shifts) >= size).any():
        raise ValueError(
            f"`shifts` has shifts of up to {np.abs(shifts).max(0).tolist()} pixels, but they must be below {size}"
        )
    moved = np.empty_like(images)
    for out, pair, shift in zip(moved, images, shifts, strict=True):
        change = np.zeros(pair.shape, np.int16)
        (to_rows, to_columns), (from_rows, from_columns) = (
            tuple(slice(max(sign * s, 0), n + min(sign * s, 0)) for s, n in zip(shift, size, strict=True))
            for sign in (1, -1)
        )
        change[:, to_rows, to_columns] = (pair.astype(np.int16) - empty)[:, from_rows, from_columns]
        out[:] = np.clip(empty + change, 0, 255)
    return moved
