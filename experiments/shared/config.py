"""The configuration of an experiment, and its presets."""

import dataclasses
from pathlib import Path
from typing import Literal

from sts_jax import dataset, statespace, training
from sts_jax.training import TrainConfig

# The models of an experiment by the modalities they have, the main one first. The paper's are the rows of its Table 1.
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
SMALLEST = 16  # pixels, side of the smallest images in which the outline of an object can be judged
SPLITS = ("object", "trajectory")


@dataclasses.dataclass(frozen=True)
class Config:
    """One experiment: its dataset, its models, and how they are trained and evaluated."""

    collection: dataset.Collection  # the dataset
    training: TrainConfig  # of the paper's models
    state_training: TrainConfig  # of the state-space model
    model: Literal["statespace", "paper"] = "statespace"  # the state-space model, or the paper's four models
    # gradient steps of each of the paper's models (None: training.epochs decides)
    steps: tuple[int, ...] | None = None
    # of the paper's models: a subset of modalities is trained to predict all targets, or its own (paper)
    targets: Literal["all", "own"] = "all"
    rotation: Literal["matrix", "quaternion"] = "matrix"  # as the networks see it
    mask_blank_touch: bool = True  # a touch without contact is no input (False: the blank image is, as in the paper)
    # Held out: whole objects, or shuffled trajectories, so that each object is in both parts (paper). With several
    # splits, each has its own models and table.
    splits: tuple[Literal["object", "trajectory"], ...] = ("object",)
    num_shown: int = 8  # held-out trajectories in the figures
    image_size: int = 64  # pixels, side of the images that are predicted and judged
    num_samples: int = 16  # of each prediction of the state-space model (the paper's are judged by their mean)
    rerolls: int = 16  # of each start, for the ceilings
    num_rerolled: int = 256  # held-out starts, the first ones, that the ceilings are computed on


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
    """An experiment for tests: every stage, a little of each."""
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
    """The paper's schedule and choices, on all frames of so many trajectories."""
    return Config(
        collection=dataclasses.replace(
            collection,
            num_objects=num_objects,
            num_per_object=num_per_object,
            num_full=num_objects * num_per_object,  # of about 60 frames of both streams
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
    """Check the fields that the stages after the collection depend on, so that nothing is collected in vain.

    Raises:
        ValueError: A field is out of range, or two fields contradict each other. The message names the remedy.
    """
    collection, names = config.collection, tuple(MODELS["paper"])
    height, width = collection.resolution
    if height != width or height < 1:
        raise ValueError(
            f"collection.resolution must be square, got {height} x {width}: give --collection.resolution {height} "
            f"{height}"
        )
    if config.model == "statespace" and collection.crop:
        raise ValueError(
            "collection.crop must be False for the state-space model, which finds the object itself, got True: give "
            "--collection.no-crop, or --model paper"
        )
    allowed = image_sizes(config)
    if not allowed:
        raise ValueError(
            f"collection.resolution must be a size from which the model can predict images, got {height} x {width}: "
            "give --collection.resolution 64 64 or 128 128"
        )
    if config.image_size not in allowed:
        listed, nearest = ", ".join(map(str, allowed)), min(allowed, key=lambda size: abs(size - config.image_size))
        raise ValueError(
            f"image_size must be one of {listed} for collection.resolution {height} {width} and model "
            f"{config.model!r}, got {config.image_size}: give --image-size {nearest}, or a resolution that is a "
            "multiple of the image size"
        )
    if config.model == "paper" and config.steps is not None and len(config.steps) != len(names):
        raise ValueError(
            f"steps must have {len(names)} numbers, one for each of {', '.join(names)}, got {config.steps}: give "
            "--steps with as many numbers, or --steps None for training.epochs"
        )
    unknown = [split for split in config.splits if split not in SPLITS]
    if unknown or not config.splits:
        raise ValueError(f"splits must be one or more of {', '.join(SPLITS)}, got {config.splits}")


def image_sizes(config: Config) -> tuple[int, ...]:
    """The values of `image_size` that the model and the resolution of the collection allow."""
    side = config.collection.resolution[0]
    return tuple(size for size in range(SMALLEST, side + 1) if side % size == 0 and _fits(config.model, side, size))


def _fits(model: Literal["statespace", "paper"], side: int, size: int) -> bool:
    """Whether the networks exist that predict images of `size` from images of `side` pixels."""
    try:
        if model == "statespace":
            statespace.Config(input_size=side, image_size=size)
        else:
            training.paper_model(("visual",), training.Preprocessing((size, size)))
    except ValueError:
        return False
    return True


def model_folder(workdir: Path, name: str, config: Config, split: str) -> Path:
    """The folder of a model: `models/NAME`, followed by the split if that is not the experiment's first one."""
    return workdir / "models" / (name if split == config.splits[0] else f"{name}-by-{split}")


def main_model(config: Config) -> str:
    """The name of the model that the main table and the figures show."""
    return next(iter(MODELS[config.model]))


def schedule(config: Config) -> TrainConfig:
    """The options of the training of its models."""
    return config.state_training if config.model == "statespace" else config.training
