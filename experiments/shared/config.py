"""The configuration of an experiment, its presets, its checks, and one split of it in a work directory."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import optax

import sts_jax as sts
from sts_jax import dataset, evaluation, mvae, statespace, training
from sts_jax.training import Preprocessing, TrainConfig

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
MOST = 1_000_000  # largest number of anything in the evaluation
SMALLEST = 16  # side of the smallest images in which the outline of an object can be judged (pixels)
SPLITS = ("object", "trajectory")

# What the experiments have in common. The presets change these values.
COLLECTION = dataset.Collection(
    num_objects=1600,
    num_per_object=6,
    num_rendered=4,
    num_full=20,
    resolution=(128, 128),
    shares=(0.9, 0.04, 0.06),
    seed=2,
)
TRAINING = TrainConfig(batch_size=16, learning_rate=2e-3, schedule="cosine", encoder_epsilon=3.0)
STATE_TRAINING = TrainConfig(
    steps=2000,
    batch_size=32,
    learning_rate=1.5e-3,
    schedule="cosine",
    warmup=150,
    b2=0.99,
    clip=200.0,
    beta_warmup=0.2,
)


@dataclasses.dataclass(frozen=True)
class Config:
    """The configuration of an experiment: its dataset, its models, their training and their evaluation."""

    collection: dataset.Collection  # the dataset
    training: TrainConfig = TRAINING  # training of the paper's models
    state_training: TrainConfig = STATE_TRAINING  # training of the state-space model
    model: Literal["statespace", "paper"] = "statespace"  # models to train: the state-space model, or the paper's four
    # numbers of gradient steps, one for each of the paper's models. None: each is trained for training.epochs epochs
    steps: tuple[int, ...] | None = (750, 350, 400, 200)
    # modalities that the paper's models learn to predict when only some modalities are given: all of them, or only
    # the given ones (own, as in the paper)
    targets: Literal["all", "own"] = "all"
    # the condition of a scenario, such as a jerk, is always an input of the paper models' decoders. True: it is also an
    # input of their encoders, as in the paper's equation (10)
    encode_condition: bool = False
    # prior of the paper's models: standard normal (as in the paper's code), or a Gaussian that depends on the condition
    # (conditional, as in the paper's equation (10))
    prior: Literal["standard", "conditional"] = "standard"
    rotation: Literal["matrix", "quaternion"] = "matrix"  # representation of rotations in the networks
    # leave out tactile images without contact as inputs. False: use these blank images, as in the paper
    mask_blank_touch: bool = True
    # data that is held out for validation and test: whole objects (object), or a random share of all trajectories, so
    # that each object is also in the training data (trajectory, as in the paper). Each split has its own models and
    # table
    splits: tuple[Literal["object", "trajectory"], ...] = ("object",)
    # number of held-out trajectories in the figures, of objects of each class in turn, among those that are re-rolled
    num_shown: int = 8
    image_size: int = 64  # side of the images that are predicted and evaluated (pixels)
    # number of samples of each prediction of the state-space model. The paper's models are evaluated by their mean
    num_samples: int = 16
    # number of simulations of each held-out start, each with newly drawn hidden properties such as
    # friction (re-rolls). The tables show the score of their mean result as the ceiling
    rerolls: int = 16
    num_rerolled: int = 256  # number of held-out starts that are re-rolled, from the first one on

    @property
    def schedule(self) -> TrainConfig:
        """The training options of the models that the experiment trains."""
        return self.state_training if self.model == "statespace" else self.training

    @property
    def preprocessing(self) -> Preprocessing:
        """The preprocessing of the models' inputs."""
        return Preprocessing(
            self.collection.resolution if self.model == "statespace" else (self.image_size, self.image_size),
            self.collection.crop,
            rotation=self.rotation,
            mask_blank_touch=self.mask_blank_touch,
            condition_scale=self.collection.scenario.condition_scale,
        )


@dataclasses.dataclass(frozen=True)
class Run:
    """One split of an experiment in its work directory. Files of the first split have no suffix."""

    config: Config
    workdir: Path
    sensor: sts.Sensor
    split: str  # one of `config.splits`

    @property
    def suffix(self) -> str:
        """End of the names of the split's files and models, such as `-by-trajectory`."""
        return "" if self.split == self.config.splits[0] else f"-by-{self.split}"

    @property
    def main_model(self) -> str:
        """Name of the model that the main table and the figures show."""
        return next(iter(MODELS[self.config.model]))

    @property
    def figures(self) -> Path:
        """Folder of the figures."""
        return self.workdir / f"figures{self.suffix}"

    def folder(self, model: str) -> Path:
        """Folder of a model."""
        return self.workdir / "models" / f"{model}{self.suffix}"


Log = Callable[[int, dict[str, float]], None]  # arguments: step of a record, other numbers of the record by name


@dataclasses.dataclass(frozen=True)
class Extensions:
    """Your own loss, optimiser, logger, metrics, table columns and modalities for an experiment.

    A field that you do not set selects the library's own part. Functions cannot be compared: after a change of the loss
    or the optimiser, use a new work directory, and after a change of a metric's function, rename the metric.
    """

    # Function that receives the configuration of a model, and returns the loss for it
    loss: Callable[[mvae.Config | statespace.Config], training.Loss] | None = None
    # Optimiser of all models, in place of Adam with the options of the configuration
    optimiser: optax.GradientTransformation | None = None
    # JSON values that describe the loss and the optimiser. They are stored with each model, and a resumed training must
    # have the same notes
    notes: dict[str, Any] | None = None
    # Function that receives the name of a model, and returns the argument `log` of `training.train` for it
    log: Callable[[str], Log] | None = None
    metrics: tuple[evaluation.Metric, ...] = evaluation.METRICS  # metrics of metrics.json and table-full.md
    columns: tuple[evaluation.Column, ...] = evaluation.COLUMNS  # columns of table.md
    # Further modalities of the paper's model with all modalities (`--model paper`). Their errors are further metrics
    measurements: tuple[dataset.Measurement, ...] = ()

    @property
    def scored(self) -> tuple[evaluation.Metric, ...]:
        """All metrics: those of the field `metrics`, and the error of each modality in `measurements`."""
        return (*self.metrics, *(evaluation.measurement_error(one) for one in self.measurements))


NONE = Extensions()


def long(default: Config, *, num_objects: int = 6000, num_per_object: int = 10, steps: int = 8000) -> Config:
    """A configuration with more objects and gradient steps, which takes hours."""
    collection = dataclasses.replace(
        default.collection, num_objects=num_objects, num_per_object=num_per_object, shares=(0.97, 0.01, 0.02)
    )
    training = dataclasses.replace(default.state_training, steps=steps)
    return dataclasses.replace(default, collection=collection, state_training=training)


def smoke(default: Config) -> Config:
    """Reduce a configuration to a short experiment that runs every stage, for tests."""
    return dataclasses.replace(
        default,
        collection=dataclasses.replace(
            default.collection,
            num_objects=16,
            num_per_object=2,
            num_rendered=None,
            num_full=4,
            objects_per_shard=8,
            shares=(0.7, 0.1, 0.2),
            seed=0,
        ),
        training=dataclasses.replace(default.training, batch_size=8, log_every=2, checkpoint_every=4),
        state_training=dataclasses.replace(
            default.state_training, steps=8, warmup=0, batch_size=8, log_every=2, checkpoint_every=4
        ),
        steps=(8, 8, 8, 8),
        rerolls=4,
        num_samples=4,
    )


def paper(collection: dataset.Collection, *, num_objects: int, num_per_object: int) -> Config:
    """The models, the training schedule and the options of the paper, for the scenario and classes of a collection."""
    return Config(
        dataset.Collection(
            collection.scenario,
            collection.categories,
            num_objects=num_objects,
            num_per_object=num_per_object,
            num_full=num_objects * num_per_object,  # all trajectories, with about 60 frames each
            crop=True,
            objects_per_shard=20,
            seed=collection.seed,
        ),
        training=TrainConfig(epochs=200, batch_size=64, learning_rate=1e-3),
        state_training=dataclasses.replace(STATE_TRAINING, steps=None),
        model="paper",
        steps=None,
        targets="own",
        encode_condition=True,
        prior="conditional",
        rotation="quaternion",
        mask_blank_touch=False,
        splits=("trajectory", "object"),
    )


def check(config: Config, own: Extensions = NONE) -> None:
    """Find a mistake in the configuration before the dataset is collected."""
    collection = config.collection
    collection.check()
    height, width = collection.resolution
    if height != width:
        raise ValueError(f"collection.resolution must be square, got {height} x {width}: give {height} {height}")
    if config.model == "statespace" and collection.crop:
        raise ValueError(
            "collection.crop must be False for the state-space model: give --collection.no-crop, or --model paper"
        )
    if config.image_size < SMALLEST or height % config.image_size:
        raise ValueError(
            f"image_size must be >= {SMALLEST} and divide the side of collection.resolution, {height}, got "
            f"{config.image_size}"
        )
    if config.model == "paper":
        training.paper_model(("visual",), config.preprocessing)  # raises an error if no network has this image size
        if config.steps is not None and len(config.steps) != len(MODELS["paper"]):
            raise ValueError(
                f"steps must have one number for each model ({', '.join(MODELS['paper'])}), or be None for "
                f"--training.epochs, got {config.steps}"
            )
    if config.model == "statespace":
        check_warmup(config.state_training, "state_training")
    else:
        check_warmup(config.training, "training", config.steps)
    for name in ("num_shown", "num_samples", "rerolls", "num_rerolled"):
        if getattr(config, name) < 1:
            raise ValueError(f"{name} must be >= 1, got {getattr(config, name)}")
        if getattr(config, name) > MOST:
            raise ValueError(f"{name} must be <= {MOST}, got {getattr(config, name)}")
    for number in config.steps or ():
        dataclasses.replace(config.training, steps=number)  # raises an error for a number out of range
    if not config.splits or not set(config.splits) <= set(SPLITS):
        raise ValueError(f"splits must be one or more of {', '.join(SPLITS)}, got {config.splits}")
    for split in config.splits:
        _check_parts(collection, split)
    if own.measurements and config.model != "paper":
        raise ValueError(
            f"measurements must be empty for model={config.model!r}, got the modality {own.measurements[0].name!r}: "
            "remove it, or use model='paper'"
        )


def check_warmup(training: TrainConfig, option: str, steps: tuple[int, ...] | None = None) -> None:
    """Raise a `ValueError` unless a warm-up is shorter than each training, of `steps` or else `training.steps`."""
    name, each = (f"{option}.steps", training.steps) if steps is None else ("the least of steps", min(steps))
    if training.schedule == "cosine" and each is not None and training.warmup >= each:
        raise ValueError(f"{option}.warmup must be smaller than {name} ({each}), got {training.warmup}")


def _check_parts(collection: dataset.Collection, split: str) -> None:
    """Raise a `ValueError` unless each part of a split has at least one object or trajectory."""
    if split == "object":
        items, sizes = "objects", {name: len(part) for name, part in dataset.split_objects(collection).items()}
    else:
        items, count = "trajectories", collection.num_objects * collection.rendered_per_object
        train = round(evaluation.train_share(collection.shares, split) * count)
        sizes = {"train": train, "test": count - train}
    name = min(sizes, key=sizes.__getitem__)
    if sizes[name] < 1:
        more = "raise --collection.num-objects"
        if collection.meshes is not None:
            more = f"add usable objects to the folder ({3 * dataset.LEAST} are enough), give --splits trajectory"
        raise ValueError(
            f"the part {name!r} of the split by {split} is empty: there are {sum(sizes.values())} {items}, and "
            f"collection.shares is {collection.shares}: {more}, or give other --collection.shares, such as 0.7 0.1 0.2"
        )
