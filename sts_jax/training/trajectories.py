"""Functions that make training arrays from trajectories, and the model configurations that fit these arrays."""

import dataclasses
import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, UInt8

from sts_jax import mvae, optics, physics, statespace
from sts_jax.dataset import Ends, Measurement, Pairs, Views, reduced_images
from sts_jax.sensor import Sensor
from sts_jax.training.arrays import Arrays
from sts_jax.training.preprocess import Preprocessing

SOME = 512  # number of items that are encoded at once


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
        pairs: First and last frames of trajectories, from `dataset.Dataset.pairs`.
        modalities: Modalities of the model, some of `visual`, `tactile` and `pose`.
        preprocessing: Preprocessing that encodes poses and conditions, and detects contacts in tactile images. If the
            first tactile image of a trajectory shows no contact, the trajectory gives a sample without the input
            `tactile`.
        blank: Tactile image of the empty sensor, uint8 `(height, width, 3)`, from `dataset.empty_frame`.
        measurements: Further modalities of the model. `pairs.measurements` must have their values.

    Returns:
        The arrays, and the preprocessing with new values of `absent` and `scales`. `absent` lists the modalities that
        no sample has as an input, and `arrays.inputs` omits them. If no first frame shows a contact, `tactile` is in
        `absent`. A further modality is in `absent` if it was measured in no first frame. `scales` contains the scale of
        each further modality that is a vector.

    Raises:
        ValueError: `pairs.measurements` lacks a further modality.
    """
    lacking = [own.name for own in measurements if own.name not in pairs.measurements]
    if lacking:
        raise ValueError(
            f"pairs.measurements lacks {', '.join(lacking)}: pass to Dataset.pairs the same argument `measurements` "
            "that you pass here"
        )
    scales = tuple((own.name, float(own.scale)) for own in measurements if not own.is_image)
    preprocessing = dataclasses.replace(preprocessing, scales=scales)
    code = np.asarray(_pose_codes(preprocessing, pairs.pose))
    found = {"visual": pairs.visual, "tactile": pairs.tactile, "pose": code}
    for own in measurements:
        values = pairs.measurements[own.name]
        found[own.name] = values if own.is_image else np.asarray(preprocessing.encode(own.name, jnp.asarray(values)))
    condition = np.asarray(preprocessing.encode_condition(jnp.asarray(pairs.condition)))
    further = tuple(own.name for own in measurements)
    return _arrays(found, modalities, preprocessing, blank, condition if condition.shape[1] else None, further)


def image_arrays(
    visual: UInt8[np.ndarray, "n 2 h w 3"],
    tactile: UInt8[np.ndarray, "n 2 h w 3"],
    modalities: tuple[str, ...],
    preprocessing: Preprocessing,
    blank: UInt8[np.ndarray, "h w 3"],
) -> tuple[Arrays, Preprocessing]:
    """Make the training arrays of an `mvae` model from images without poses, as from a real sensor.

    Args:
        visual: First and last visual image of each trajectory, for example from `hardware.recorded_images`.
        tactile: First and last tactile image of each trajectory.
        modalities: Modalities of the model, one or both of `visual` and `tactile`.
        preprocessing: Preprocessing that detects contacts in tactile images. For images of a real camera, use the
            result of `touch_of_noisy_images`. If the first tactile image of a trajectory shows no contact, the
            trajectory gives a sample without the input `tactile`.
        blank: Tactile image of the empty sensor.

    Returns:
        The arrays, and the preprocessing with a new value of `absent`. This field names the modalities that are
        missing from the inputs of every sample. If `tactile` is a modality and no first image shows a contact, `absent`
        is `("tactile",)`, and the arrays have no input `tactile`. Otherwise `absent` is empty.

    Raises:
        ValueError: `modalities` is empty or has a name other than `visual` and `tactile`, or the images are not uint8
            with the resolution `preprocessing.resolution`.
    """
    found, shape = {"visual": visual, "tactile": tactile}, (2, *preprocessing.resolution, 3)
    if not modalities or not set(modalities) <= set(found):
        raise ValueError(
            "modalities must contain at least one of the names 'visual' and 'tactile', and no other name, got "
            f"{modalities}"
        )
    for name, images in found.items():
        if images.dtype != np.uint8 or images.shape != (len(visual), *shape) or not len(images):
            raise ValueError(
                f"{name} is {images.dtype} of shape {images.shape}, but visual and tactile must be uint8 of shape (n, "
                f"{', '.join(map(str, shape))}) with the same n >= 1: convert and resize the images to this shape"
            )
    return _arrays(found, modalities, preprocessing, blank, None)


def _arrays(
    found: dict[str, np.ndarray],
    modalities: tuple[str, ...],
    preprocessing: Preprocessing,
    blank: np.ndarray,
    condition: np.ndarray | None,
    further: tuple[str, ...] = (),
) -> tuple[Arrays, Preprocessing]:
    """Make the training arrays of an `mvae` model from encoded first and last frames by modality."""
    # NaN marks frames in which a further modality was not measured.
    known = {name: ~np.isnan(found[name]).reshape(*found[name].shape[:2], -1).any(-1) for name in further}
    present = {name: mask[:, 0] for name, mask in known.items() if not mask[:, 0].all()}
    if "tactile" in modalities:
        present["tactile"] = _touched(found["tactile"], preprocessing, blank)
    absent = tuple(name for name, mask in present.items() if not mask.any())
    names = (*modalities, *further)
    arrays = Arrays(
        inputs={name: np.ascontiguousarray(found[name][:, 0]) for name in names if name not in absent},
        targets={name: np.ascontiguousarray(found[name][:, 1]) for name in names},
        present={name: mask for name, mask in present.items() if name not in absent},
        target_present={name: mask[:, 1] for name, mask in known.items() if not mask[:, 1].all()},
        condition=condition,
    )
    return arrays, dataclasses.replace(preprocessing, absent=absent)


def paper_model(
    modalities: tuple[str, ...], preprocessing: Preprocessing, *, measurements: Sequence[Measurement] = ()
) -> mvae.Config:
    """Make the configuration of the networks in the See-Through-your-Skin paper.

    In the loss, the weight of the reconstruction error is 1 for images and 1000 for the pose. A further modality has
    the weight `Measurement.weight`.

    Args:
        modalities: Modalities of the model, some of `visual`, `tactile` and `pose`.
        preprocessing: Preprocessing of the training arrays.
        measurements: Further modalities of the model.

    Returns:
        The configuration of an `mvae` model.

    Raises:
        ValueError: `modalities` has a name other than `visual`, `tactile` and `pose`.
    """
    shape = (*preprocessing.resolution, 3)
    known = {name: mvae.Modality(name, "image", shape, start=0.7) for name in ("visual", "tactile")}
    known["pose"] = mvae.Modality("pose", "vector", (preprocessing.pose_size,), weight=1000.0)
    for name in modalities:
        if name not in known:
            raise ValueError(
                f"modalities contains {name!r}, but it may contain only {', '.join(map(repr, known))}: remove "
                f"{name!r} from modalities, and pass it as a dataset.Measurement in the argument measurements"
            )
    kept = [known[name] for name in modalities]
    kept += [
        mvae.Modality(own.name, "image" if own.is_image else "vector", own.shape, weight=float(own.weight))
        for own in measurements
    ]
    return mvae.Config(tuple(kept), condition=len(preprocessing.condition_scale))


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
        pairs: First and last frames of trajectories, from `dataset.Dataset.pairs`. The images must have
            `model.input_size` pixels on each side.
        model: Configuration of the model, from `state_model`.
        scenario: Scenario of the trajectories.
        preprocessing: Preprocessing that encodes poses and conditions, and detects contacts in tactile images. A
            condition consists of known quantities of the scenario, such as the acceleration of the pad.
        empty: `visual` and `tactile` image of the empty sensor, from `dataset.empty_frame`, uint8 `(size, size, 3)`.
            The size is `model.input_size`.
        views: Rendered visual images of objects in initial poses, from `dataset.Dataset.views`. The motion of these
            objects is not simulated. The images are used only if `visual` is an input of the model.
        falls: First and last poses of further trajectories without images, from `dataset.Dataset.ends`.

    Returns:
        The arrays.

    Raises:
        ValueError: The outcome of a trajectory is not in `scenario.outcomes`, or the images cannot be reduced to
            `model.image_size`.
    """
    ends: list[Pairs | Ends] = [pairs] if falls is None else [pairs, falls]
    outcome, *other_outcomes = (_outcome_index(own.outcome, scenario) for own in ends)
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
    numbers = np.array([int(known) for known in scenario.outcomes])
    if not np.isin(outcome, numbers).all():
        raise ValueError(
            f"the trajectories have the outcomes {np.unique(outcome).tolist()}, but the scenario "
            f"{type(scenario).__name__} has the outcomes {numbers.tolist()}: give the scenario of the dataset"
        )
    return (outcome[:, None] == numbers).argmax(1).astype(np.int32)


def state_codes(
    preprocessing: Preprocessing, pose: np.ndarray, support: np.ndarray, mass: np.ndarray, com: np.ndarray
) -> np.ndarray:
    """Encode the true pose, shape and mass of each of n objects as a state code, a vector for a state-space model.

    Args:
        preprocessing: Preprocessing of the model.
        pose: Positions (m) and unit quaternions (w, x, y, z), `(n, 7)`.
        support: Support functions of the convex hulls for the 128 unit vectors `objects.DIRECTIONS`, `(n, 128)` (m).
        mass: Masses, `(n,)` (kg).
        com: Centres of mass in the mesh frame, `(n, 3)` (m).

    Returns:
        State codes, `(n, code)`. `statespace.state.State` describes the parts of a code.
    """
    encode = jax.jit(statespace.encode)
    parts = []
    size = min(SOME, len(pose))
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
        empty: `visual` and `tactile` image of the empty sensor, from `dataset.empty_frame`, uint8 `(size, size, 3)`.
            The size is the side length of the input images (pixels).
        image_size: Side length of the predicted images (pixels). It must divide the side length of the input images.

    Returns:
        The configuration, and the preprocessing with a new value of `absent`. This field names the modalities that are
        missing from the inputs of every sample. If no first frame shows a contact, `tactile` is not an input of the
        model, and `absent` is `("tactile",)`. Otherwise `absent` is empty.

    Raises:
        ValueError: The images are not square or are cropped, or their side length is not a multiple of `image_size`.
    """
    height, width = preprocessing.resolution
    if height != width or preprocessing.crop:
        raise ValueError(
            f"resolution is {preprocessing.resolution} and crop is {preprocessing.crop}, but a state-space model needs "
            "square images of the whole view: give a preprocessing with resolution=(n, n) and crop=False"
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
