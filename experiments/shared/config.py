"""The configuration of an experiment, and its presets."""

import dataclasses
import itertools
from pathlib import Path
from typing import Literal

import numpy as np

import sts_jax as sts
from sts_jax import dataset, evaluation, statespace, training
from sts_jax.dataset.collection import PARTS
from sts_jax.training import TrainConfig

# The models of each kind and their modalities. The first model of a kind is the main one, which the tables and figures
# show. The paper's models are the rows of its Table 1.
MODELS: dict[str, dict[str, tuple[str, ...]]] = {
    "statespace": {"statespace": ("visual", "tactile", "pose")},
    "paper": {
        "mvae": ("visual", "tactile", "pose"),
        "mvae-without-pose": ("visual", "tactile"),
        "vae-visual": ("visual",),
        "vae-tactile": ("tactile",),
    },
}
TITLES = {
    "statespace": "state-space model",
    "mvae": "MVAE with pose",
    "mvae-without-pose": "MVAE without pose",
    "vae-visual": "VAE visual only",
    "vae-tactile": "VAE tactile only",
}
SMALLEST = 16  # side of the smallest images in which the outline of an object can be judged (pixels)
SPLITS = ("object", "trajectory")


@dataclasses.dataclass(frozen=True)
class Config:
    """The configuration of an experiment: its dataset, its models, their training and their evaluation."""

    collection: dataset.Collection  # the dataset
    training: TrainConfig  # training of the paper's models
    state_training: TrainConfig  # training of the state-space model
    model: Literal["statespace", "paper"] = "statespace"  # models to train: the state-space model, or the paper's four
    # numbers of gradient steps, one for each of the paper's models. None: each is trained for training.epochs epochs
    steps: tuple[int, ...] | None = None
    # modalities that the paper's models learn to predict when only some modalities are given: all of them, or only
    # the given ones (own, as in the paper)
    targets: Literal["all", "own"] = "all"
    rotation: Literal["matrix", "quaternion"] = "matrix"  # representation of rotations in the networks
    # leave out tactile images without contact as inputs. False: use these blank images, as in the paper
    mask_blank_touch: bool = True
    # data that is held out for validation and test: whole objects (object), or a random share of all trajectories, so
    # that each object is also in the training data (trajectory, as in the paper). Each split has its own models and
    # table
    splits: tuple[Literal["object", "trajectory"], ...] = ("object",)
    num_shown: int = 8  # number of held-out trajectories in the figures
    image_size: int = 64  # side of the images that are predicted and evaluated (pixels)
    # number of samples of each prediction of the state-space model. The paper's models are evaluated by their mean
    num_samples: int = 16
    # number of simulations of each held-out start, each with newly drawn hidden properties such as
    # friction (re-rolls). The tables show the score of their mean result as the ceiling
    rerolls: int = 16
    num_rerolled: int = 256  # number of held-out starts that are re-rolled, from the first one on


# The same for all scenarios. The presets set `steps`.
STATE_TRAINING = TrainConfig(
    batch_size=32,
    learning_rate=1.5e-3,
    schedule="cosine",
    warmup=150,
    b2=0.99,
    clip=200.0,
    beta_warmup=0.2,
)


def smoke(default: Config) -> Config:
    """Reduce a configuration to a short experiment that runs every stage, for tests."""
    collection = dataclasses.replace(
        default.collection,
        num_objects=16,
        num_per_object=2,
        num_rendered=None,
        num_full=4,
        objects_per_shard=8,
        symmetries=False,
        shares=(0.7, 0.1, 0.2),
        seed=0,
    )
    schedule = dataclasses.replace(default.training, batch_size=8, log_every=2, checkpoint_every=4)
    state = dataclasses.replace(
        default.state_training, steps=8, warmup=0, batch_size=8, log_every=2, checkpoint_every=4
    )
    return dataclasses.replace(
        default,
        collection=collection,
        training=schedule,
        state_training=state,
        steps=(8, 8, 8, 8),
        rerolls=4,
        num_samples=4,
    )


def paper(collection: dataset.Collection, *, num_objects: int, num_per_object: int) -> Config:
    """Make the configuration with the models, the training schedule and the options of the paper.

    All frames of all trajectories are rendered.

    Args:
        collection: Settings for the data of the default experiment, such as the scenario and the object classes.
        num_objects: Number of objects.
        num_per_object: Number of trajectories of each object.
    """
    return Config(
        collection=dataclasses.replace(
            collection,
            num_objects=num_objects,
            num_per_object=num_per_object,
            num_full=num_objects * num_per_object,  # all trajectories, with about 60 frames each
            num_rendered=None,
            num_views=0,
            symmetries=False,
            resolution=(64, 64),
            crop=True,
            shares=(0.7, 0.1, 0.2),
            objects_per_shard=20,
        ),
        training=TrainConfig(epochs=200, batch_size=64, learning_rate=1e-3),
        state_training=STATE_TRAINING,
        model="paper",
        targets="own",
        rotation="quaternion",
        mask_blank_touch=False,
        splits=("trajectory", "object"),
    )


def check(config: Config) -> None:
    """Check the fields that later stages need, so that a mistake is found before the dataset is collected.

    Raises:
        ValueError: A field is out of range, or two fields contradict each other. The message names the remedy.
    """
    collection, names = config.collection, tuple(MODELS["paper"])
    collection.check(sts.Sensor())
    height, width = collection.resolution
    if height != width:
        raise ValueError(
            f"collection.resolution must be square, got {height} x {width}: give --collection.resolution {height} "
            f"{height}"
        )
    if config.model == "statespace" and collection.crop:
        raise ValueError(
            "collection.crop is True, but it must be False for the state-space model, which locates the object in the "
            "whole image: give --collection.no-crop, or --model paper"
        )
    allowed = image_sizes(config)
    if not allowed:
        raise ValueError(
            f"collection.resolution must be a size that model {config.model!r} supports, got {height} x {width}: "
            "give --collection.resolution 64 64 or 128 128"
        )
    if config.image_size not in allowed:
        listed, nearest = ", ".join(map(str, allowed)), min(allowed, key=lambda size: abs(size - config.image_size))
        raise ValueError(
            f"image_size must be one of {listed} for collection.resolution {height} {width} and model "
            f"{config.model!r}, got {config.image_size}: give --image-size {nearest}, or choose "
            "another --collection.resolution and an --image-size that divides it"
        )
    if config.model == "paper" and config.steps is not None and len(config.steps) != len(names):
        raise ValueError(
            f"steps must have one number for each model ({', '.join(names)}), got {config.steps}: change --steps, or "
            "give --steps None to train each model for --training.epochs epochs"
        )
    trained, option = (
        (config.state_training, "state_training") if config.model == "statespace" else (config.training, "training")
    )
    if trained.schedule == "cosine" and trained.steps is not None and trained.warmup >= trained.steps:
        raise ValueError(
            f"{option}.warmup must be smaller than {option}.steps ({trained.steps}), got {trained.warmup}: give "
            f"--{option.replace('_', '-')}.warmup {trained.steps // 10}, for example"
        )
    for name in ("num_shown", "num_samples", "rerolls", "num_rerolled"):
        if getattr(config, name) < 1:
            raise ValueError(f"{name} must be >= 1, got {getattr(config, name)}")
    unknown = [split for split in config.splits if split not in SPLITS]
    if unknown or not config.splits:
        raise ValueError(
            f"splits must be one or more of {', '.join(SPLITS)}, got {config.splits}: give --splits "
            f"{SPLITS[0]}, for example"
        )
    for split in config.splits:
        _check_parts(collection, split)


def _check_parts(collection: dataset.Collection, split: str) -> None:
    """Raise a `ValueError` unless each part of a split of the dataset contains at least one object or trajectory."""
    shares, count = np.array(collection.shares), collection.num_objects
    parts: tuple[str, ...] = PARTS
    items, few = "objects", f"collection.num_objects is {count}"
    if split == "trajectory":
        rest = evaluation.train_share(collection.shares, split)
        shares, count = np.array([rest, 1 - rest]), count * collection.rendered_per_object
        parts, items = ("train", "test"), "trajectories"
        few = f"the number of trajectories with images is {count}"
    empty = [name for name, size in zip(parts, _sizes(shares, count), strict=True) if size < 1]
    if not empty:
        return
    if min(shares) <= 0:
        raise ValueError(
            f"collection.shares must be > 0 for {', '.join(parts)}, got {collection.shares}: give "
            "--collection.shares 0.7 0.1 0.2, for example"
        )
    least = next(n for n in itertools.count(count + 1) if min(_sizes(shares, n)) >= 1)
    more = "raise --collection.num-objects"
    if collection.meshes is not None:
        more = "add usable objects to the folder (objects.txt in the work directory lists the unusable ones)"
    raise ValueError(
        f"{few}, so the part {empty[0]!r} of the split by {split} has no {items}. With collection.shares "
        f"{collection.shares}, at least {least} {items} are needed: {more}, or give other --collection.shares, such as "
        "0.7 0.1 0.2"
    )


def _sizes(shares: np.ndarray, count: int) -> np.ndarray:
    """The numbers of items in the parts of a split of `count` items."""
    return np.diff(np.round(np.cumsum([0, *shares]) * count)).astype(int)


def image_sizes(config: Config) -> tuple[int, ...]:
    """The values of `image_size` that the model and the resolution of the collected images allow, in pixels."""
    side = config.collection.resolution[0]
    return tuple(size for size in range(SMALLEST, side + 1) if side % size == 0 and _fits(config.model, side, size))


def _fits(model: Literal["statespace", "paper"], side: int, size: int) -> bool:
    """Return whether the model can predict images with a side of `size` from images with a side of `side` pixels."""
    try:
        if model == "statespace":
            statespace.Config(input_size=side, image_size=size)
        else:
            training.paper_model(("visual",), training.Preprocessing((size, size)))
    except ValueError:
        return False
    return True


def model_folder(workdir: Path, name: str, config: Config, split: str) -> Path:
    """The folder of a model that was trained on data split by object or by trajectory.

    The argument `split` is "object" if whole objects are held out from the training, and "trajectory" if random
    trajectories are held out. The folder is `models/NAME` if `split` is the first entry of `config.splits`, and
    `models/NAME-by-SPLIT` otherwise.
    """
    return workdir / "models" / (name if split == config.splits[0] else f"{name}-by-{split}")


def main_model(config: Config) -> str:
    """The name of the model that the main table and the figures show."""
    return next(iter(MODELS[config.model]))


def schedule(config: Config) -> TrainConfig:
    """The training options of the models that the experiment trains."""
    return config.state_training if config.model == "statespace" else config.training
