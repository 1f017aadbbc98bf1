"""Training arrays in memory or on disk: batches, how they are made, and the model configurations that fit them."""

import dataclasses
import functools
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int, UInt8

from sts_jax import mvae, optics, physics, statespace
from sts_jax._checked import checked, in_32_bits
from sts_jax.dataset import Dataset, Ends, Measurement, Pairs, Views, reduced_images
from sts_jax.dataset.records import Shard
from sts_jax.sensor import Sensor
from sts_jax.training.preprocess import Preprocessing

Batch = dict[str, Any]  # the fields of `Arrays` by name, with the samples of one batch
Config = mvae.Config | statespace.Config  # configuration of a model of either kind

_CHUNK = 512  # number of items that are encoded at once
_FRAMES = 256  # number of frames that are read at once


@dataclass(frozen=True, eq=False)
class Source:
    """Images of the stored frames of a dataset, in memory or on disk. Several arrays of `Arrays` share one source."""

    # Receives indices of stored frames, int (n,). Returns the images by name, uint8 (n, height, width, 3)
    read: Callable[[np.ndarray], dict[str, np.ndarray]]
    identity: str  # identity of the dataset and size of the images, for checksums


@dataclass(frozen=True, eq=False)
class Shared:
    """An array of images, `images[i]` being an image of frame `rows[i]` of a source. `Arrays` reads a batch of them."""

    source: Source
    name: str  # `visual` or `tactile`
    rows: np.ndarray  # int (samples,): indices of stored frames, see `Dataset.frames`
    shape: tuple[int, ...]  # (samples, height, width, 3)
    dtype: ClassVar = np.dtype(np.uint8)

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, index: Any) -> np.ndarray:
        return self.source.read(self.rows[index])[self.name]


@dataclass(frozen=True)
class Arrays:
    """A training set. The first axis of all arrays is the sample. Images are uint8, or float32 in [0, 1]."""

    inputs: dict[str, Any]  # inputs of the model, from first frames, each a NumPy array or `Shared`
    # Targets of the model, from last frames. A state-space model also needs the state codes `state` of the first
    # frames, pose codes `pose`, and indices `outcome` into the outcomes of the scenario. If it is a one-step model, it
    # needs the pose codes of all frames, `course` (samples, frames, code), too.
    targets: dict[str, Any]
    # bool (samples,): True if a sample has the input. An input without a mask is present in all samples.
    present: dict[str, np.ndarray] = field(default_factory=dict)
    target_present: dict[str, np.ndarray] = field(default_factory=dict)  # the same for targets, for `mvae` models only
    # (samples, condition), encoded condition of the scenario. For a one-step state-space model, in each frame:
    # (samples, frames, condition)
    condition: np.ndarray | None = None
    # The other fields are for state-space models. `visual` and `tactile` image of the empty sensor, (size, size, 3)
    empty: dict[str, np.ndarray] = field(default_factory=dict)
    # First frames without a trajectory, as `visual` and `state`, (views, *shape)
    views: dict[str, np.ndarray] = field(default_factory=dict)
    # Trajectories without images, as `state`, `pose` (or `course`), `outcome` and any `condition`, (falls, *shape)
    falls: dict[str, np.ndarray] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for group in (self._tree(), self.views, self.falls):
            leaves = jax.tree_util.tree_leaves_with_path(group)
            lengths = {jax.tree_util.keystr(path, simple=True, separator="/"): len(x) for path, x in leaves}
            if len(set(lengths.values())) > 1 or 0 in lengths.values():
                raise ValueError(f"arrays must have the same number of samples, at least 1, got the lengths {lengths}")

    def __len__(self) -> int:
        return len(next(iter(self.targets.values())))

    def take(self, index: np.ndarray, **further: np.ndarray) -> Batch:
        """The arrays of some samples by field, with `empty`, and with the rows `further` of `views` and `falls`."""
        leaves, tree = jax.tree.flatten(self._tree())
        shared = [leaf for leaf in leaves if isinstance(leaf, Shared)]
        images = {}
        for source in {leaf.source for leaf in shared}:  # each frame is read once for all arrays
            rows = np.unique(np.concatenate([leaf.rows[index] for leaf in shared if leaf.source is source]))
            images[source] = rows, source.read(rows)

        def taken(leaf: np.ndarray | Shared) -> np.ndarray:
            if not isinstance(leaf, Shared):
                return leaf[index]
            rows, read = images[leaf.source]
            return read[leaf.name][np.searchsorted(rows, leaf.rows[index])]

        batch: Batch = jax.tree.unflatten(tree, map(taken, leaves)) | {"empty": self.empty}
        return batch | {name: {k: x[rows] for k, x in getattr(self, name).items()} for name, rows in further.items()}

    def checksum(self) -> int:
        """CRC-32 of the names, shapes, types and values of all arrays, or of the dataset and rows of shared images."""
        value = 0
        further = {"empty": self.empty, "views": self.views, "falls": self.falls}
        for path, x in jax.tree_util.tree_leaves_with_path(self._tree() | further):
            value = zlib.crc32(f"{path}{x.shape}{x.dtype}".encode(), value)
            if isinstance(x, Shared):
                value, x = zlib.crc32(f"{x.source.identity} {x.name}".encode(), value), x.rows
            value = zlib.crc32(np.ascontiguousarray(x).data, value)
        return value

    def _tree(self) -> Batch:
        return {name: getattr(self, name) for name in ("inputs", "targets", "present", "target_present", "condition")}


def order(seed: int, samples: int, batch_size: int, start: int, stop: int) -> Iterator[np.ndarray]:
    """Iterate over the batches `start` to `stop` - 1 of a training, each as sample indices `(batch_size,)`.

    Each epoch is a random permutation of all samples. Batch k does not depend on `start` and `stop`.
    """
    permutations: dict[int, np.ndarray] = {}
    for number in range(start, stop):
        epoch, place = np.divmod(np.arange(number * batch_size, (number + 1) * batch_size), samples)
        permutations = {
            e: permutations[e] if e in permutations else np.random.default_rng([seed, e]).permutation(samples)
            for e in np.unique(epoch)
        }
        yield np.array([permutations[e][p] for e, p in zip(epoch, place, strict=True)])


def _check_values(what: str, x: Any, mask: np.ndarray | None) -> None:
    """Raise a ValueError if an array has numbers that a loss takes for others. Masked samples do not count."""
    if x.dtype == np.uint8:
        if len(x.shape) < 4:
            raise ValueError(f"{what} is uint8, which counts as an image and is divided by 255: give float32")
        return
    if not np.issubdtype(x.dtype, np.floating) or not len(x):
        return
    x = np.asarray(x) if mask is None else np.asarray(x)[mask]
    if not np.isfinite(x).all():
        raise ValueError(f"{what} has values that are not finite: mask these samples, or leave them out")
    if x.ndim == 4 and x.size and (x.min() < 0 or x.max() > 1):
        raise ValueError(f"{what} has values from {x.min():g} to {x.max():g}, but float images must be in [0, 1]")


def check(model: Config, arrays: Arrays, absent: tuple[str, ...] = ()) -> None:
    """Raise a ValueError if a training set does not fit a model."""
    if isinstance(model, mvae.Config):
        targets = {modality.name: modality.shape for modality in model.modalities}
        inputs = {name: shape for name, shape in targets.items() if name not in absent}
    else:
        code, size = (statespace.POSE_CODE,), (model.input_size, model.input_size, 3)
        inputs = {name: code if name == "pose" else size for name in model.inputs}
        targets = dict.fromkeys(statespace.IMAGES, (model.image_size, model.image_size, 3))
        targets |= {"state": (statespace.STATE_CODE,), "pose": code, "outcome": ()}
        if model.stride:
            frames = arrays.targets["course"].shape[1] if "course" in arrays.targets else model.stride + 1
            targets["course"] = (max(frames, model.stride + 1), *code)
    for kind, shapes, values in (("inputs", inputs, arrays.inputs), ("targets", targets, arrays.targets)):
        actual = {name: x.shape[1:] for name, x in values.items()}
        if actual != shapes:
            raise ValueError(f"the samples of `{kind}` have the shapes {actual}, but the model needs {shapes}")
    if isinstance(model, statespace.Config) and (highest := arrays.targets["outcome"].max()) >= model.outcomes:
        raise ValueError(f"`outcome` has the index {highest}, but the model has {model.outcomes} outcomes")
    if not set(arrays.present) <= set(inputs):
        raise ValueError(f"`present` has masks for {list(arrays.present)}, but the inputs are {list(inputs)}")
    for kind, masks in (("inputs", arrays.present), ("targets", arrays.target_present)):
        for name, x in getattr(arrays, kind).items():
            _check_values(f"the array {name!r} of `{kind}`", x, masks.get(name))
    width = 0 if arrays.condition is None else arrays.condition.shape[-1]
    if width != model.condition:
        raise ValueError(f"`condition` has width {width}, but the model has condition={model.condition}")


@in_32_bits
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
        preprocessing: Encodes poses and conditions. A trajectory without a contact in its first frame, see
            `Preprocessing.touched`, gives a sample without the input `tactile`.
        blank: Tactile image of the empty sensor, uint8 `(height, width, 3)`, from `dataset.empty_frame`.
        measurements: Further modalities of the model. `pairs.measurements` must have their values.

    Returns:
        The arrays, and the preprocessing with new values of `absent` (the modalities that no first frame has, which
        `arrays.inputs` omits) and `scales` (of the measurements that are vectors).
    """
    further = tuple(measurement.name for measurement in measurements)
    if lacking := set(further) - set(pairs.measurements):
        raise ValueError(f"pairs.measurements lacks {lacking}: pass the same `measurements` to Dataset.pairs")
    scales = tuple((m.name, float(m.scale)) for m in measurements if not m.is_image)
    preprocessing = dataclasses.replace(preprocessing, scales=scales)
    code = np.asarray(preprocessing.encode_pose(pairs.pose))
    frames = {"visual": pairs.visual, "tactile": pairs.tactile, "pose": code}
    for m in measurements:
        values = pairs.measurements[m.name]
        frames[m.name] = values if m.is_image else np.asarray(preprocessing.encode(m.name, jnp.asarray(values)))
    condition = np.asarray(preprocessing.encode_condition(jnp.asarray(pairs.condition)))
    return _arrays(frames, modalities, preprocessing, blank, condition if condition.shape[1] else None, further)


@in_32_bits
@checked
def image_arrays(
    visual: UInt8[np.ndarray, "n 2 h w 3"],
    tactile: UInt8[np.ndarray, "n 2 h w 3"],
    modalities: tuple[str, ...],
    preprocessing: Preprocessing,
    blank: UInt8[np.ndarray, "h w 3"],
) -> tuple[Arrays, Preprocessing]:
    """Make the training arrays of an `mvae` model as `frame_arrays`, from images without poses, as of a real sensor.

    Args:
        visual: First and last images, for example from `hardware.Recordings.images`.
        modalities: Modalities of the model, one or both of `visual` and `tactile`.
        preprocessing: Detects contacts. For images of a camera, from `touch_of_noisy_images`.
        blank: Tactile image of the empty sensor.
    """
    if blank.shape[:2] != preprocessing.resolution:
        raise ValueError(f"the images have {blank.shape[:2]} pixels: resize them to {preprocessing.resolution}")
    return _arrays({"visual": visual, "tactile": tactile}, modalities, preprocessing, blank, None)


def _arrays(
    frames: dict[str, np.ndarray],
    modalities: tuple[str, ...],
    preprocessing: Preprocessing,
    blank: np.ndarray,
    condition: np.ndarray | None,
    further: tuple[str, ...] = (),
) -> tuple[Arrays, Preprocessing]:
    # NaN marks frames in which a further modality was not measured.
    measured = {name: ~np.isnan(frames[name]).reshape(*frames[name].shape[:2], -1).any(-1) for name in further}
    present = {name: mask[:, 0] for name, mask in measured.items() if not mask[:, 0].all()}
    if "tactile" in modalities:
        present["tactile"] = _touched(frames["tactile"][:, 0], preprocessing, blank)
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


@in_32_bits
@checked
def step_arrays(
    data: Dataset,
    trajectories: Int[np.ndarray, "n"],
    modalities: tuple[str, ...],
    preprocessing: Preprocessing,
    blank: UInt8[np.ndarray, "h w 3"],
    *,
    stride: int = 1,
    in_memory: bool = True,
    image_size: int | None = None,
) -> tuple[Arrays, Preprocessing]:
    """Make the training arrays of a one-step `mvae` model: inputs from each frame, targets from `stride` frames later.

    If the scenario has a condition, the time since the first frame (s) is its last number. `preprocessing` encodes the
    condition without this number.

    Args:
        trajectories: Indices of trajectories with images of all frames, from `evaluation.rows_of` for example.
        modalities: Modalities of the model, some of `visual`, `tactile` and `pose`.
        preprocessing: Encodes poses and conditions, and finds the frames with a contact, as for `frame_arrays`.
        blank: Tactile image of the empty sensor, of the size that the model receives.
        in_memory: False reads the images of each batch from the dataset's files, which must then remain in place.
        image_size: Side to which the images are reduced (pixels), see `dataset.reduced`. None: they are not reduced.

    Returns:
        The arrays, and the preprocessing with new values of `stride`, `period`, `condition_scale` and `absent`.
    """
    trajectory, before, after = data.steps(trajectories, stride).T
    if lacking := set(modalities) - {"visual", "tactile", "pose"}:
        raise ValueError(f"modalities must be some of visual, tactile and pose, got {lacking.pop()!r}")
    size = tuple(data.collection["resolution"]) if image_size is None else (image_size, image_size)
    if not blank.shape[:2] == preprocessing.resolution == size:
        raise ValueError(
            f"`blank` has {blank.shape[:2]} pixels and preprocessing.resolution is {preprocessing.resolution}, but the "
            f"images have {size}: reduce all with `image_size`, `dataset.reduced_images` and resolution={size}"
        )
    time, given = data.trajectory["time"], data.trajectory["condition"][trajectory]
    condition = np.asarray(preprocessing.encode_condition(jnp.asarray(given)))
    scale = preprocessing.condition_scale
    if condition.shape[1]:
        passed = time[trajectory, before] - time[trajectory, 0]
        condition, scale = np.concatenate([condition, passed[:, None]], axis=1), (*scale, 1.0)

    rows = data.stored(np.stack([trajectory] * 2), np.stack([before, after]))
    source = _source(data, np.unique(rows), modalities, in_memory, size)
    inputs: dict[str, Any] = {}
    targets: dict[str, Any] = {}
    for group, frames, stored in ((inputs, before, rows[0]), (targets, after, rows[1])):
        for name in modalities:
            if name == "pose":
                group[name] = np.asarray(preprocessing.encode_pose(data.trajectory["pose"][trajectory, frames]))
            else:
                group[name] = Shared(source, name, stored, (len(stored), *size, 3))
    present = {"tactile": _touched(inputs["tactile"], preprocessing, blank)} if "tactile" in modalities else {}
    absent = () if all(mask.any() for mask in present.values()) else ("tactile",)
    arrays = Arrays(
        inputs={name: x for name, x in inputs.items() if name not in absent},
        targets=targets,
        present={name: mask for name, mask in present.items() if name not in absent},
        condition=condition if condition.shape[1] else None,
    )
    period = float(time[0, stride] - time[0, 0])
    return arrays, dataclasses.replace(
        preprocessing, stride=stride, period=period, condition_scale=scale, absent=absent
    )


def _source(
    data: Dataset, rows: np.ndarray, modalities: tuple[str, ...], in_memory: bool, size: tuple[int, ...]
) -> Source:
    """The images of the stored frames `rows`, of the given height and width."""
    names = [name for name in modalities if name != "pose"]
    opened: dict[int, Shard] = {}

    def read(rows: np.ndarray) -> dict[str, np.ndarray]:
        images = data.images(rows, opened=opened)
        found = {name: getattr(images, name) for name in names}
        return found if size == images.visual.shape[1:3] else reduced_images(found, size[0])

    identity = f"{data.identity} {size}"
    read(rows[:1])  # an error is raised here, not in the training
    if not in_memory:
        return Source(read, identity)
    whole = {name: np.empty((len(rows), *size, 3), np.uint8) for name in names}
    for start in range(0, len(rows) if names else 0, _FRAMES):
        for name, images in read(rows[start : start + _FRAMES]).items():
            whole[name][start : start + _FRAMES] = images
    place = np.zeros(len(data.frames), np.int64)
    place[rows] = np.arange(len(rows))
    return Source(lambda rows: {name: images[place[rows]] for name, images in whole.items()}, identity)


def paper_model(
    modalities: tuple[str, ...],
    preprocessing: Preprocessing,
    *,
    measurements: Sequence[Measurement] = (),
    encode_condition: bool = False,
    prior: Literal["standard", "conditional"] = "standard",
) -> mvae.Config:
    """Make the configuration of the networks in the See-Through-your-Skin paper. Arguments as for `frame_arrays`.

    The weight of the reconstruction error is 1 for images, 1000 for the pose, and `Measurement.weight` otherwise. The
    fields `encode_condition` and `prior` of `mvae.Config` have no effect without a condition. The paper's equation (10)
    is `encode_condition=True, prior="conditional"`.
    """
    shape = (*preprocessing.resolution, 3)
    standard = {name: mvae.Modality(name, "image", shape, start=0.7) for name in ("visual", "tactile")}
    standard["pose"] = mvae.Modality("pose", "vector", (preprocessing.pose_size,), weight=1000.0)
    further = [
        mvae.Modality(m.name, "image" if m.is_image else "vector", m.shape, weight=float(m.weight))
        for m in measurements
    ]
    if unknown := set(modalities) - set(standard):
        raise ValueError(f"modalities must be some of {', '.join(standard)}, got {unknown.pop()!r}")
    chosen = [standard[name] for name in modalities]
    width = len(preprocessing.condition_scale)
    if not width:
        encode_condition, prior = False, "standard"
    return mvae.Config((*chosen, *further), condition=width, encode_condition=encode_condition, prior=prior)


@in_32_bits
def state_arrays(
    pairs: Pairs,
    model: statespace.Config,
    scenario: physics.Scenario,
    preprocessing: Preprocessing,
    empty: dict[str, np.ndarray],
    *,
    views: Views | None = None,
    falls: Ends | None = None,
    data: Dataset | None = None,
) -> Arrays:
    """Make the training arrays of a state-space model.

    Args:
        pairs: From `dataset.Dataset.pairs`, with images of `model.input_size` pixels on each side. A one-step model
            learns to render the second frame, which may be any frame.
        model: From `state_model`.
        empty: `visual` and `tactile` image of the empty sensor, uint8, from `dataset.empty_frame`.
        views: From `dataset.Dataset.views`. They are used only if `visual` is an input of the model.
        falls: Further trajectories without images, from `dataset.Dataset.ends`.
        data: Dataset of the trajectories, for the poses in all their frames. Needed for a one-step model only.
    """
    if model.stride and pairs.frame is not None and pairs.frame[:, 0].any():
        raise ValueError("the first frames of the pairs are not frame 0, where a one-step model begins: frames=(0, k)")
    code = np.asarray(preprocessing.encode_pose(pairs.pose))
    last = reduced_images({"visual": pairs.visual[:, 1], "tactile": pairs.tactile[:, 1]}, model.image_size)
    ends = _ends(pairs, model, scenario, preprocessing, data)
    inputs = {"visual": pairs.visual[:, 0], "tactile": pairs.tactile[:, 0], "pose": code[:, 0]}
    felt = _touched(pairs.tactile[:, 0], preprocessing, empty["tactile"]) if "tactile" in model.inputs else None
    view_arrays, fall_arrays = {}, {}
    if views is not None and len(views.pose) and "visual" in model.inputs:
        state = state_codes(preprocessing, views.pose, views.support, views.mass, views.com)
        view_arrays = {"visual": views.visual, "state": state}
    if falls is not None and len(falls.pose):
        fall_arrays = _ends(falls, model, scenario, preprocessing, data)
    return Arrays(
        inputs={name: np.ascontiguousarray(inputs[name]) for name in model.inputs},
        condition=ends.pop("condition", None),
        targets=last | {"pose": code[:, 1]} | ends,
        present={} if felt is None else {"tactile": felt},
        empty=empty,
        views=view_arrays,
        falls=fall_arrays,
    )


def _ends(
    ends: Pairs | Ends,
    model: statespace.Config,
    scenario: physics.Scenario,
    preprocessing: Preprocessing,
    data: Dataset | None,
) -> dict[str, np.ndarray]:
    """Codes of the first states, final pose codes, indices into `scenario.outcomes` and any encoded conditions.

    For a one-step model, they are the pose codes `course` and the conditions of all frames, and one outcome.
    """
    numbers = np.array([int(outcome) for outcome in scenario.outcomes])
    if not np.isin(ends.outcome, numbers).all():
        raise ValueError(
            f"the trajectories have the outcomes {np.unique(ends.outcome).tolist()}, but the scenario "
            f"{type(scenario).__name__} has the outcomes {numbers.tolist()}: give the scenario of the dataset"
        )
    outcome, condition = (ends.outcome[:, None] == numbers).argmax(1), ends.condition
    if model.stride:
        if data is None:
            raise ValueError("a one-step model needs the poses in all frames: give data=, the dataset of the pairs")
        pose, time = (data.trajectory[name][ends.trajectory] for name in ("pose", "time"))
        if model.stride >= pose.shape[1]:
            raise ValueError(
                f"stride is {model.stride}, but the trajectories have {pose.shape[1]} frames: give a smaller stride"
            )
        name, outcome = "course", np.zeros_like(outcome)
        if condition.shape[1]:
            passed = (time - time[:, :1])[..., None]
            each = np.broadcast_to(condition[:, None], (*time.shape, condition.shape[1]))
            condition = np.concatenate([each, passed], axis=2)
    else:
        name, pose = "pose", ends.pose[:, 1]
    encoded = np.asarray(preprocessing.encode_condition(jnp.asarray(condition)))
    return {
        "state": state_codes(preprocessing, ends.pose[:, 0], ends.support, ends.mass, ends.com),
        name: np.asarray(preprocessing.encode_pose(pose)),
        "outcome": outcome.astype(np.int32),
        **({"condition": encoded} if encoded.shape[-1] else {}),
    }


@in_32_bits
def state_codes(
    preprocessing: Preprocessing, pose: np.ndarray, support: np.ndarray, mass: np.ndarray, com: np.ndarray
) -> np.ndarray:
    """Encode the true states of n objects as state codes `(n, code)`.

    Args:
        pose: `(n, 7)`.
        support: Support functions of the convex hulls for `objects.DIRECTIONS`, `(n, 128)` (m).
        mass: `(n,)` (kg).
        com: Centres of mass in the mesh frame, `(n, 3)` (m).
    """
    parts = []
    size = min(_CHUNK, len(pose))
    for start in range(0, len(pose), size):  # bounds the memory
        # The last part is filled up with copies of the last object, because another size would compile anew.
        rows = np.minimum(np.arange(start, start + size), len(pose) - 1)
        code = preprocessing.encode_pose(pose[rows])
        parts.append(np.asarray(statespace.encode(code, support[rows], mass[rows], com[rows])))
    return np.concatenate(parts)[: len(pose)]


@in_32_bits
def state_model(
    pairs: Pairs,
    sensor: Sensor,
    scenario: physics.Scenario,
    preprocessing: Preprocessing,
    empty: dict[str, np.ndarray],
    *,
    image_size: int = 64,
    inputs: Sequence[str] | None = None,
    stride: int = 0,
) -> tuple[statespace.Config, Preprocessing]:
    """Make the configuration of a state-space model with the network sizes of the experiments.

    Args:
        pairs: The training trajectories. They and `empty` are as for `state_arrays`.
        preprocessing: Its images must be square and show the whole view.
        image_size: Side of the predicted images (pixels), a divisor of the side of the input images.
        inputs: Inputs of the model, some of `visual`, `tactile` and `pose`. None: all that the first frames have.
        stride: Number of frames that one step of a one-step model takes. 0: the model predicts the last frame. If the
            scenario has a condition, that of a one-step model ends with the time since the first frame (s).

    Returns:
        The configuration, and the preprocessing with new values of `absent`, as from `frame_arrays`, and for a one-step
        model of `stride`, `period` and `condition_scale`.
    """
    height, width = preprocessing.resolution
    if height != width or preprocessing.crop:
        raise ValueError(f"a state-space model needs resolution=(n, n) and crop=False, got {preprocessing}")
    absent = () if _touched(pairs.tactile[:, 0], preprocessing, empty["tactile"]).any() else ("tactile",)
    chosen = [name for name in statespace.INPUTS if name not in absent] if inputs is None else inputs
    if lacking := set(chosen) & set(absent):
        raise ValueError(f"inputs has {lacking.pop()!r}, but no first frame shows a contact: leave it out")
    if stride:
        scale = preprocessing.condition_scale
        preprocessing = dataclasses.replace(
            preprocessing, stride=stride, period=stride / scenario.rate, condition_scale=(*scale, 1.0) if scale else ()
        )
    model = statespace.Config(
        inputs=tuple(chosen),
        outcomes=1 if stride else len(scenario.outcomes),
        outcome_names=() if stride else tuple(scenario.named(int(outcome)) for outcome in scenario.outcomes),
        stride=stride,
        condition=len(preprocessing.condition_scale),
        vectors=scenario.vectors if scenario.quantities else 1,
        input_size=height,
        image_size=image_size,
        imprints=True,
        shading=24,
        outlines=32,
        reflected=scenario.symmetric,
        camera_distance=float(sensor.camera.distance),
        view=float(optics.full_window(sensor.camera, preprocessing.resolution)[2]),
        position_scale=preprocessing.position_scale,
    )
    return model, dataclasses.replace(preprocessing, absent=absent)


def _touched(tactile: np.ndarray | Shared, preprocessing: Preprocessing, blank: np.ndarray) -> np.ndarray:
    """Whether each tactile image `(n, height, width, 3)` shows a contact, in parts that bound the memory."""
    parts, size = [np.zeros(0, bool)], min(_FRAMES, len(tactile))
    for start in range(0, len(tactile), size or 1):
        # The last part is filled up with copies of the last image, because another size would compile anew.
        rows = np.minimum(np.arange(start, start + size), len(tactile) - 1)
        parts.append(np.asarray(_contacts(preprocessing, tactile[rows], blank)))
    return np.concatenate(parts)[: len(tactile)]


@functools.partial(jax.jit, static_argnums=0)
def _contacts(
    preprocessing: Preprocessing, tactile: UInt8[Array, "n h w 3"], blank: UInt8[Array, "h w 3"]
) -> Bool[Array, "n"]:
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
        images: First and last images, all visual or all tactile.
        empty: Image of the empty pad, visual or tactile like `images`.
        shifts: Rows and columns by which each trajectory is shifted (pixels), to larger indices if positive.
    """
    size = images.shape[2:4]
    if (np.abs(shifts) >= size).any():
        raise ValueError(f"`shifts` must be below {size} pixels, got up to {np.abs(shifts).max(0).tolist()}")
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
