"""The cells of Table 1: one model of a scenario, a time scale and a seed, its training, and its scores.

A final-step model predicts the last frame from the first one. A one-step model predicts the next frame, and is rolled
out to the last one on its own predictions.
"""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Literal, NamedTuple, get_args

import jax
import numpy as np

import sts_jax as sts
from experiments.shared import config as common
from experiments.shared.config import MODELS, TITLES
from experiments.shared.evaluate import SEED, identity, record, stale
from experiments.shared.run import Job, apart, collect, train_model
from experiments.shared.terminal import Bar
from sts_jax import dataset, evaluation, storage, training
from sts_jax._devices import cores
from sts_jax.training import Arrays, TrainConfig

Scenario = Literal["freefall", "inclined", "perturbed"]
Name = Literal[
    "mvae",
    "mvae-without-pose",
    "vae-visual",
    "vae-tactile",
    "statespace",
    "statespace-visual-tactile",
    "statespace-visual-pose",
    "statespace-visual",
]
Scale = Literal["final", "step"]
Scores = dict[str, np.ndarray]  # scores of each item by "WEIGHTS/INPUTS/METRIC"

PAPER = MODELS["paper"]
STATE: dict[str, tuple[str, ...]] = {  # the state-space models and their inputs, all of them first
    **MODELS["statespace"],
    "statespace-visual-tactile": ("visual", "tactile"),
    "statespace-visual-pose": ("visual", "pose"),
    "statespace-visual": ("visual",),
}
NAMES: dict[str, str] = {
    **TITLES,
    "statespace-visual-tactile": "state-space model of vision and touch",
    "statespace-visual-pose": "state-space model of vision and pose",
    "statespace-visual": "state-space model of vision",
}
TOUCHLESS = ("freefall",)  # scenarios in whose first frames nothing touches the pad
ALL, ONE_STEP = "all inputs", "one step"  # of the inputs, all. Instead of them: the errors of one step, of all moments
SUBSETS = (("visual",), ("tactile",), ("visual", "tactile"), ("visual", "pose"))
WEIGHTS = ("last", "best")  # weights of the last step, and those with the least validation loss
REFERENCES = dict(zip(("constant", "copy", "ceiling"), (*evaluation.BASELINES[:2], evaluation.CEILING), strict=True))
SCORED = tuple(m for m in evaluation.METRICS if m.name in ("visual_bce", "tactile_bce", "position_on_pad"))
SELECTION = ("scenarios", "models", "scales", "seeds")
FREE = (*SELECTION, "in_memory")  # fields that do not change a cell

# Seconds on two cores of a 2.8 GHz Xeon, with images of 64 x 64 pixels: a gradient step of 16 samples of each of the
# paper's models (with and without touch in the first frames) and of 32 samples of a state-space model, compilation and
# checkpoints of a cell, a predicted frame of the paper's models and a sample of a state-space model, a rendered frame,
# and a re-roll.
_STEP_S = {"mvae": 0.29, "mvae-without-pose": 0.13, "vae-visual": 0.05, "vae-tactile": 0.05}
_TOUCHLESS_STEP_S = {**_STEP_S, "mvae": 0.13, "mvae-without-pose": 0.05}
_STATE_STEP_S, _CELL_S, _PREDICTED_S, _SAMPLE_S, _FRAME_S, _REROLL_S = 0.25, 15.0, 0.004, 0.005, 0.01, 0.03


@dataclasses.dataclass(frozen=True)
class Config:
    """The datasets, the models, their training and their evaluation."""

    # datasets. All trajectories are stored in full, whatever num_full and num_rendered say
    freefall: dataset.Collection
    inclined: dataset.Collection
    perturbed: dataset.Collection
    training: TrainConfig  # training of each of the paper's models
    state_training: TrainConfig  # training of each state-space model
    # the cells that are computed. These four may change from one run to the next in the same work directory
    scenarios: tuple[Scenario, ...] = ("freefall", "inclined", "perturbed")
    models: tuple[Name, ...] = get_args(Name)
    scales: tuple[Scale, ...] = ("final", "step")
    seeds: tuple[int, ...] = (0, 1, 2)
    stride: int = 1  # frames of a step of the one-step models (1: the paper's)
    # modalities that the paper's models learn to predict when only some modalities are given: all of them, or only
    # the given ones (own, as in the paper)
    targets: Literal["all", "own"] = "all"
    rotation: Literal["matrix", "quaternion"] = "matrix"  # representation of rotations in the paper's models
    # leave out tactile images without contact as inputs. False: use these blank images, as in the paper
    mask_blank_touch: bool = True
    # the paper's models of a scenario with a condition: the condition is an input of the encoders too, and the prior is
    # learned for each condition (equation 10 of the paper), or they are as in the paper's code
    encode_condition: bool = False
    prior: Literal["standard", "conditional"] = "standard"
    # held-out data: whole objects, or a random share of the trajectories (as in the paper)
    split: Literal["object", "trajectory"] = "object"
    # read the frames of one-step trainings into memory. False: from the disk, batch by batch. It may change, too
    in_memory: bool = True
    num_validated: int = 4  # trajectories whose frames give the validation loss of the paper's one-step models
    moments: tuple[int, ...] = (0, 4, 12, 30)  # frames from which the one-step error is measured, besides the roll-out
    num_samples: int = 8  # samples of each prediction of a state-space model, whose mean image is scored
    rerolls: int = 12  # simulations of each held-out start, whose mean is the ceiling
    num_rerolled: int = 60  # held-out starts that are re-rolled, from the first one on

    def collection(self, scenario: str) -> dataset.Collection:
        """The dataset of a scenario, with images of all frames."""
        chosen: dataset.Collection = getattr(self, scenario)
        return dataclasses.replace(chosen, num_full=chosen.num_trajectories, num_rendered=None)


class Cell(NamedTuple):
    """One trained model."""

    scenario: str
    model: str  # one of `NAMES`
    scale: str  # final or step
    seed: int

    @property
    def name(self) -> str:
        """Place of its model below `models`, and of its scores below `scores`."""
        return f"{self.scenario}/{self.model}-{self.scale}-seed{self.seed}"


@dataclasses.dataclass(frozen=True)
class Scene:
    """The dataset of a scenario."""

    name: str
    collection: dataset.Collection
    data: dataset.Dataset
    rows: Mapping[str, np.ndarray]  # indices of the trajectories in each part of the split
    train: dataset.Pairs  # first and last frames
    validation: dataset.Pairs
    test: dataset.Pairs
    moments: Mapping[int, dataset.Pairs]  # held-out frames t and t + stride, by t
    empty: dict[str, np.ndarray]  # image of the untouched sensor for each stream, uint8


def check(config: Config) -> None:
    """Find a mistake in the configuration before anything is collected."""
    for name in SELECTION:
        chosen = getattr(config, name)
        if not chosen or len(set(chosen)) < len(chosen):
            raise ValueError(f"{name} must have one or more different values, got {chosen}")
    state = [name for name in config.models if name in STATE]
    for scenario in config.scenarios:
        collection = config.collection(scenario)
        common.check(dataclasses.replace(_as_experiment(config, collection), model="statespace" if state else "paper"))
        last = collection.scenario.frames - 1
        if "step" in config.scales and (config.stride < 1 or last % config.stride):
            raise ValueError(
                f"stride must divide the {last} frames from the first to the last of {scenario}, got {config.stride}"
            )
    if min(config.moments, default=0) < 0:
        raise ValueError(f"moments must be >= 0, got {config.moments}")
    for name in ("num_validated", "num_samples", "rerolls", "num_rerolled"):
        if getattr(config, name) < 1:
            raise ValueError(f"{name} must be >= 1, got {getattr(config, name)}")
    for seed in config.seeds:
        dataclasses.replace(config.training, seed=seed)  # raises an error for a seed out of range


def _as_experiment(config: Config, collection: dataset.Collection) -> common.Config:
    """The same as an experiment of one scenario, for its checks and its preprocessing."""
    return common.Config(
        collection,
        training=config.training,
        state_training=config.state_training,
        model="paper",
        steps=None,
        rotation=config.rotation,
        mask_blank_touch=config.mask_blank_touch,
        splits=(config.split,),
        image_size=collection.resolution[0],
        rerolls=config.rerolls,
    )


def cells(config: Config) -> Iterator[Cell]:
    """All cells, seed by seed, so that the table is complete after the first seed.

    State-space models of some of the inputs exist for the final step only. Those that differ only in touch are left out
    where no first frame has touch.
    """
    for seed in config.seeds:
        for scenario in config.scenarios:
            for model in config.models:
                for scale in config.scales:
                    part = model in STATE and model != "statespace"
                    same = scenario in TOUCHLESS and model in ("statespace-visual-tactile", "statespace-visual-pose")
                    if not part or (scale == "final" and not same):
                        yield Cell(scenario, model, scale, seed)


def estimated_s(config: Config, cell: Cell) -> float:
    """Seconds of a cell on this machine, roughly."""
    collection, steps = config.collection(cell.scenario), 1
    samples = round(evaluation.train_share(collection.shares, config.split) * collection.num_trajectories)
    items = len(WEIGHTS) * collection.shares[2] * collection.num_trajectories
    if cell.scale == "step":
        samples *= collection.scenario.frames - config.stride
        steps = (collection.scenario.frames - 1) // config.stride
    if cell.model in STATE:
        schedule, step_s = config.state_training, _STATE_STEP_S / 32
        predicting_s = items * config.num_samples * _SAMPLE_S
    else:
        blank = cell.scenario in TOUCHLESS and cell.scale == "final"
        schedule, step_s = config.training, (_TOUCHLESS_STEP_S if blank else _STEP_S)[cell.model] / 16
        predicting_s = items * steps * _PREDICTED_S
    if cell.scale == "final":
        predicting_s *= len(SUBSETS)
    training_s = schedule.total(samples) * schedule.batch_size * step_s
    return _CELL_S * _slower() + (training_s + predicting_s) * _size(collection) * _slower()


def estimated_collecting_s(config: Config, scenario: str) -> float:
    """Seconds of the collection and of the re-rolls of a scenario on this machine, roughly."""
    collection = config.collection(scenario)
    frames = collection.num_trajectories * collection.scenario.frames * _FRAME_S * _size(collection)
    return (frames + config.rerolls * config.num_rerolled * _REROLL_S) * _slower()


def _size(collection: dataset.Collection) -> float:
    return collection.resolution[0] ** 2 / 64**2


def _slower() -> float:
    return 2 / min(cores(), 4)


def scene(config: Config, name: str, sensor: sts.Sensor, workdir: Path) -> Scene:
    """Collect the dataset of a scenario, or open it, and read the first and last frames of each part."""
    collection = config.collection(name)
    data = collect(collection, sensor, workdir / "datasets" / name)
    rows = apart(evaluation.rows_of(data, config.split), config.split)
    train, validation, test = (data.pairs(rows[part]) for part in ("train", "validation", "test"))
    fitting = [t for t in config.moments if t + config.stride < collection.scenario.frames]
    moments = {t: data.pairs(rows["test"], frames=(t, t + config.stride)) for t in fitting}
    frame = dataset.empty_frame(sensor, collection)
    empty = {"visual": frame.visual, "tactile": frame.tactile}
    return Scene(name, collection, data, rows, train, validation, test, moments, empty)


def compute(config: Config, sensor: sts.Sensor, workdir: Path, scene: Scene, cell: Cell) -> bool:
    """Train and score a cell, unless its scores are already there. True if anything was done."""
    folder, path = workdir / "models" / cell.name, workdir / "scores" / f"{cell.name}.npz"
    if stale(workdir, f"scores of {cell.name}", inputs(config, workdir, scene, cell)) is None:
        return False
    training.claim_split(folder, scene.rows)
    job, validation = prepared(config, sensor, scene, cell)
    train_model(job, folder, config.targets, validation=validation)
    del job
    storage.write_arrays(path, score(config, scene, cell, folder))
    record(workdir, f"scores of {cell.name}", inputs(config, workdir, scene, cell), [path])
    return True


def inputs(config: Config, workdir: Path, scene: Scene, cell: Cell) -> dict[str, str]:
    """The checksums on which the scores of a cell depend."""
    folder = workdir / "models" / cell.name
    how = {
        "split": config.split,
        "moments": config.moments,
        "samples": config.num_samples,
        "metrics": [metric.name for metric in SCORED],
    }
    models = {f"models/{cell.name}/{name}".rstrip("/"): identity(folder / name) for name in ("", "best")}
    return {"dataset": scene.data.identity, **models, "the evaluation": storage.digest(how)}


def prepared(config: Config, sensor: sts.Sensor, scene: Scene, cell: Cell) -> tuple[Job, Arrays]:
    """The training of a cell, and the arrays of its validation loss."""
    make = _state if cell.model in STATE else _paper
    return make(config, sensor, scene, cell)


def _paper(config: Config, sensor: sts.Sensor, scene: Scene, cell: Cell) -> tuple[Job, Arrays]:
    del sensor
    modalities, blank = PAPER[cell.model], scene.empty["tactile"]
    plain = _as_experiment(config, scene.collection).preprocessing
    if cell.scale == "final":
        arrays, view = training.frame_arrays(scene.train, modalities, plain, blank)
        held, _ = training.frame_arrays(scene.validation, modalities, plain, blank)
    else:
        few = scene.rows["validation"][: config.num_validated]
        arrays, view = training.step_arrays(
            *(scene.data, scene.rows["train"], modalities, plain, blank),
            stride=config.stride,
            in_memory=config.in_memory,
        )
        held, _ = training.step_arrays(scene.data, few, modalities, plain, blank, stride=config.stride)
    model = training.paper_model(modalities, view, encode_condition=config.encode_condition, prior=config.prior)
    schedule = dataclasses.replace(config.training, seed=cell.seed)
    return Job(cell.name, schedule, model, arrays, view, scene.empty), held


def _state(config: Config, sensor: sts.Sensor, scene: Scene, cell: Cell) -> tuple[Job, Arrays]:
    scenario, side = scene.collection.scenario, scene.collection.resolution[0]
    plain = dataclasses.replace(_as_experiment(config, scene.collection).preprocessing, rotation="matrix")
    stride = config.stride if cell.scale == "step" else 0
    model, view = training.state_model(
        scene.train, sensor, scenario, plain, scene.empty, image_size=side, stride=stride
    )
    model = dataclasses.replace(model, inputs=tuple(name for name in model.inputs if name in STATE[cell.model]))
    train = _with_frames_between(scene) if stride else scene.train
    arrays, validation = (
        training.state_arrays(pairs, model, scenario, view, scene.empty, data=scene.data)
        for pairs in (train, scene.validation)
    )
    schedule = dataclasses.replace(config.state_training, seed=cell.seed)
    return Job(cell.name, schedule, model, arrays, view, scene.empty), validation


def _with_frames_between(scene: Scene) -> dataset.Pairs:
    """Each training trajectory with its last frame and with a random one, so that a decoder learns all moments."""
    rows, last = scene.rows["train"], scene.collection.scenario.frames - 1
    random = np.random.default_rng(0).integers(1, last + 1, len(rows))
    return scene.data.pairs(np.tile(rows, 2), frames=(0, np.concatenate([np.full(len(rows), last), random])))


def score(config: Config, scene: Scene, cell: Cell, folder: Path) -> Scores:
    """The scores of both weights of a cell, for all its inputs and for some of them, and the errors of one step."""
    scores: Scores = {}
    scenario, num_samples = scene.collection.scenario, config.num_samples if cell.model in STATE else 0
    with Bar() as bar:
        for weights, place in zip(WEIGHTS, (folder, folder / "best"), strict=True):
            predictor = sts.Predictor.load(place)

            def predict(pairs: dataset.Pairs, subset: tuple[str, ...], predictor: sts.Predictor = predictor) -> Scores:
                out = evaluation.predict(predictor, subset, pairs, scenario, num_samples=num_samples)
                return _errors(scene, out, pairs)

            every = asked(cell, predictor.modalities)
            for number, (given, subset) in enumerate(every.items()):
                bar(f"score {cell.name}", number, len(every), f"{weights}, {given}")
                scores |= _named(f"{weights}/{given}", predict(scene.test, subset))
            if cell.scale == "step":
                # A state-space model infers the state from frame 0, in which the object is at rest.
                moments = [t for t in scene.moments if t == 0 or cell.model not in STATE]
                steps = [predict(scene.moments[t], predictor.modalities) for t in moments]
                scores |= _named(f"{weights}/{ONE_STEP}", _summed(steps))
    return scores


def _errors(scene: Scene, predicted: evaluation.Predicted, test: dataset.Pairs) -> Scores:
    return evaluation.score(predicted, test, outcomes=scene.collection.scenario.outcomes, metrics=SCORED)


def _named(name: str, errors: Scores) -> Scores:
    return {f"{name}/{metric}": values for metric, values in errors.items()}


def _summed(moments: Sequence[Scores]) -> Scores:
    """The sums of the errors of images over several moments."""
    names = [name for name in moments[0] if name.endswith("_bce")] if moments else []
    return {name: np.sum([errors[name] for errors in moments], axis=0) for name in names}


def asked(cell: Cell, modalities: tuple[str, ...]) -> dict[str, tuple[str, ...]]:
    """The inputs from which a model is scored: all, and for a final-step model also some of them."""
    some = SUBSETS if cell.scale == "final" else ()
    chosen = {" and ".join(s): s for s in some if set(s) < set(modalities)}
    return {**chosen, ALL: modalities}


def references(config: Config, sensor: sts.Sensor, workdir: Path, scene: Scene) -> Scores:
    """The scores of the constant, the copy and the ceiling, at the last frame and one step after each moment."""
    path, part = workdir / "scores" / f"{scene.name}/references.npz", f"references of {scene.name}"
    how = [config.split, config.moments, config.stride, config.rerolls, config.num_rerolled]
    checksums = {"dataset": scene.data.identity, "the evaluation": storage.digest(how)}
    if stale(workdir, part, checksums) is None:
        return storage.read_arrays(path, f"delete {path}")
    baselines = evaluation.baselines(scene.collection.scenario, scene.train, scene.test)
    rows = {name: baselines[title] for name, title in REFERENCES.items() if title in baselines}
    few = scene.test.take(slice(config.num_rerolled))
    with Bar() as bar:
        total = config.rerolls * len(few.object)
        key = jax.random.key(SEED)
        rows["ceiling"] = evaluation.ceiling(
            scene.collection, sensor, few, config.rerolls, key, progress=lambda done: bar("re-roll", done, total)
        )
    scores: Scores = {}
    for name, predicted in rows.items():
        scores |= _named(f"{name}/{ALL}", _errors(scene, predicted, scene.test))
    steps = scene.moments.values()
    copies = [_errors(scene, evaluation.Predicted(x.visual[:, 0], x.tactile[:, 0]), x) for x in steps]
    scores |= _named(f"copy/{ONE_STEP}", _summed(copies))
    storage.write_arrays(path, scores)
    record(workdir, part, checksums, [path])
    return scores
