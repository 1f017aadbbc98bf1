"""The stages that experiments share: collect, train, evaluate. Each resumes and shows its progress."""

import dataclasses
import functools
import itertools
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import jax
import numpy as np

import sts_jax as sts
from experiments import pictures, results
from experiments.ceilings import Ceilings, ceilings
from experiments.progress import Bar, say
from sts_jax import _files, dataset, evaluation, mvae, statespace, training
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
# The main table shows the main model from the first five of these inputs that it can be given.
MAIN_SUBSETS = ("visual", "tactile", "visual and tactile", "visual and pose", "all inputs", "pose")
KNOWN = "visual and the true state"  # pose, shape and mass of the simulation
JUDGED_SUBSETS = ("visual", "visual and tactile", "all inputs")  # whose outcome probabilities are drawn
CHUNK = 64  # items predicted by one call


@dataclasses.dataclass(frozen=True)
class Config:
    """One experiment: its dataset, its models, and how they are trained and evaluated."""

    collection: dataset.Collection
    training: TrainConfig  # of the paper's models
    state_training: TrainConfig  # of the state-space model
    model: Literal["statespace", "paper"] = "statespace"  # which of MODELS are trained
    steps: tuple[int, ...] | None = None  # gradient steps of each of the paper's models (None: training.epochs decide)
    targets: Literal["all", "own"] = (
        "all"  # a subset of modalities is asked for "all" targets, or for its "own" (paper)
    )
    rotation: Literal["matrix", "quaternion"] = "matrix"  # as the networks see it
    mask_blank_touch: bool = True  # a touch without contact is no input (False: the blank image is, as in the paper)
    # Held out: whole "object"s (70/10/20), or a fifth of the shuffled "trajectory"s, which shows each object on both
    # sides (paper). With several, each has its own models and table.
    splits: tuple[str, ...] = ("object",)
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


def main(config: Config, workdir: Path) -> None:
    """Collect, train, evaluate.

    Raises:
        LockedError: Another process works in the work directory.
    """
    sensor = sts.Sensor()
    with _files.lock(workdir):
        claim(config, workdir)
        data = collect(config, workdir, sensor)
        for split in config.splits:
            train(config, data, workdir, sensor, split)
            print(evaluate(config, data, workdir, sensor, split))


def claim(config: Config, workdir: Path) -> None:
    """Write `config.json`, or raise an error if an existing one differs."""
    _files.claim(workdir / "config.json", dataclasses.asdict(config))


def collect(config: Config, workdir: Path, sensor: sts.Sensor) -> dataset.Dataset:
    """Make the missing shards of the dataset and open it."""
    with Bar() as bar:
        made = dataset.collect(
            config.collection,
            sensor,
            workdir / "dataset",
            progress=lambda p: bar(f"collect: {p.stage}", p.done, p.total),
        )
    left_out = [f"collect: left out {line}" for line in made.left_out]
    for line in left_out:
        say(line)
    note(workdir / "objects.txt", left_out)
    if made.resampled:
        say(f"collect: {made.resampled} trajectories went non-finite or sank and were drawn again")
    return dataset.load(workdir / "dataset")


def note(path: Path, lines: Sequence[str]) -> None:
    """Add to a text file those of some lines that it does not have."""
    there = path.read_text(errors="replace") if path.exists() else ""
    new = "".join(f"{line}\n" for line in lines if f"{line}\n" not in there)
    if new:
        _files.write_bytes(path, (there + new).encode())


def train_share(shares: Sequence[float], split: str) -> float:
    """Of all objects, or of all trajectories where these are held out, the share that trains.

    Args:
        shares: of the collection.
        split: "object" or "trajectory".
    """
    # The paper has no validation part.
    return shares[0] if split == "object" else 1 - shares[2]


def rows_of(data: dataset.Dataset, split: str) -> dict[str, np.ndarray]:
    """Which of the trajectories with images train, validate and test."""
    if split == "object":
        return {name: data.members(name) for name in ("train", "validation", "test")}
    if split != "trajectory":
        raise ValueError(f"unknown split {split!r}: hold out by 'object' or by 'trajectory'.")
    rendered = data.rendered()
    order = rendered[np.random.default_rng(data.collection["seed"]).permutation(len(rendered))]
    cut = round(train_share(data.collection["shares"], split) * len(order))
    # Without a validation part the outcome's threshold is chosen on training trajectories.
    return {"train": np.sort(order[:cut]), "validation": np.sort(order[:cut]), "test": np.sort(order[cut:])}


def model_folder(workdir: Path, name: str, config: Config, split: str) -> Path:
    """Where a model lives: `models/NAME`, with the split behind it where it is not the experiment's first."""
    return workdir / "models" / (name if split == config.splits[0] else f"{name}-by-{split}")


class Job(NamedTuple):
    """One training of an experiment."""

    name: str  # of the model
    schedule: TrainConfig
    model: mvae.Config | statespace.Config
    arrays: training.Arrays
    preprocessing: training.Preprocessing
    empty: dict[str, np.ndarray]  # images of the untouched sensor, uint8


def jobs(
    config: Config,
    sensor: sts.Sensor,
    pairs: dataset.Pairs,
    views: dataset.Views | None = None,
    falls: dataset.Ends | None = None,
) -> Iterator[Job]:
    """The trainings of an experiment.

    Args:
        config: The experiment.
        sensor: That of the collection.
        pairs: The training trajectories, with images as they were collected.
        views: Further pictures of the training objects, for the state-space model.
        falls: Trajectories of the training objects that are used without their images, for the state-space model.
    """
    preprocessing, scenario = preprocessing_of(config), config.collection.scenario
    frame = dataset.empty_frame(sensor, config.collection)
    empty = {"visual": frame.visual, "tactile": frame.tactile}
    if config.model == "statespace":
        state, own = training.state_model(pairs, sensor, scenario, preprocessing, empty)
        arrays = training.state_moments(pairs, state, scenario, own, empty, views=views, falls=falls)
        del pairs  # as large as the arrays, which hold copies
        yield Job("statespace", config.state_training, state, arrays, own, empty)
        return
    pairs, empty = dataset.reduced(pairs, config.image_size), dataset.reduced_images(empty, config.image_size)
    for number, (name, modalities) in enumerate(MODELS["paper"].items()):
        arrays, own = training.moments(pairs, modalities, preprocessing, empty["tactile"])
        schedule = config.training
        if config.steps is not None:
            schedule = dataclasses.replace(schedule, steps=config.steps[number])
        yield Job(name, schedule, training.paper_model(modalities, own), arrays, own, empty)


def train(config: Config, data: dataset.Dataset, workdir: Path, sensor: sts.Sensor, split: str) -> None:
    """Train the models of an experiment on one split, each with a progress bar."""
    rows, more = rows_of(data, split)["train"], config.model == "statespace"
    views = data.views("train") if more else None
    falls = data.ends(data.members("train", rendered=False)) if more else None
    # The trajectories have no name here, so that `jobs` can free their memory.
    for job in jobs(config, sensor, data.pairs(rows, symmetries=True), views, falls):
        with Bar() as bar:

            def show(done: int, total: int, record: dict[str, float], bar: Bar = bar, name: str = job.name) -> None:
                bar(f"train {name}", done, total, f"loss {record['loss']:.4g}" if record else "")

            run(job, model_folder(workdir, job.name, config, split), config.targets, show)


def run(
    job: Job,
    folder: Path,
    targets: Literal["all", "own"],
    progress: Callable[[int, int, dict[str, float]], None],
) -> None:
    """Train one model in a folder, or go on where an earlier call on it stopped."""
    training.save_blank(folder, job.empty["visual"], job.empty["tactile"])
    training.train(
        job.schedule,
        job.model,
        job.arrays,
        workdir=folder,
        absent=job.preprocessing.absent,
        targets=targets,
        preprocessing=dataclasses.asdict(job.preprocessing),
        progress=progress,
    )


def preprocessing_of(config: Config) -> training.Preprocessing:
    """How an experiment's measurements are made ready for the networks."""
    collection = config.collection
    small = (config.image_size, config.image_size)
    return training.Preprocessing(
        collection.resolution if config.model == "statespace" else small,
        collection.crop,
        rotation=config.rotation,
        mask_blank_touch=config.mask_blank_touch,
        condition_scale=collection.scenario.condition_scale,
    )


def evaluate(config: Config, data: dataset.Dataset, workdir: Path, sensor: sts.Sensor, split: str) -> str:
    """Score every model on held-out trajectories and return the main table.

    Writes `metrics.json`, `table.md`, `table-full.md` and `figures/`. `metrics.json` records the checksums of
    everything that was evaluated and written. As long as they hold, nothing is done again.
    """
    suffix = "" if split == config.splits[0] else f"-by-{split}"
    done, figures = workdir / f"metrics{suffix}.json", workdir / f"figures{suffix}"
    table, complete = workdir / f"table{suffix}.md", workdir / f"table-full{suffix}.md"
    inputs = {"config.json": _files.digest(dataclasses.asdict(config)), "dataset": data.identity}
    for folder in (model_folder(workdir, name, config, split) for name in MODELS[config.model]):
        inputs[folder.relative_to(workdir).as_posix()] = results.identity(folder)
    reason = results.stale(done, inputs)
    if reason is None:
        return table.read_text()
    if done.exists() or table.exists():
        say(f"evaluate: again, because {reason}")
    scenario, rows_in = config.collection.scenario, rows_of(data, split)
    train_pairs = data.pairs(rows_in["train"], symmetries=True)
    validation, given = data.pairs(rows_in["validation"]), data.pairs(rows_in["test"])
    train_pairs, test = (dataset.reduced(pairs, config.image_size) for pairs in (train_pairs, given))
    if config.model == "paper":
        validation, given = dataset.reduced(validation, config.image_size), test
    blank = training.load_blank(model_folder(workdir, main_model(config), config, split))[0] / 255
    judge = judge_of(scenario, train_pairs)
    possible = ceilings(
        workdir,
        suffix,
        config.collection,
        sensor,
        data,
        test,
        times=config.rerolls,
        num=config.num_rerolled,
        judge=judge,
    )
    scores = dict(possible.scores)
    for title, row in evaluation.baselines(scenario, train_pairs, test).items():
        scores[title] = judge(row, test)
    shown: dict[str, evaluation.Predicted] = {}  # the first predictions of each model, for the figures
    with Bar() as bar:
        jobs = list(queries(config, workdir, split))
        for number, (title, predictor, names) in enumerate(jobs):
            bar("evaluate", number, len(jobs), title)
            row = predict(scenario, predictor, names, validation, given, blank, num_samples=number_of_samples(config))
            scores[title] = judge(row, test)
            shown[title] = evaluation.first(row, config.num_shown)
        summary = evaluation.summarise(scores, test, outcomes=scenario.outcomes)
        bar("evaluate", len(jobs), len(jobs), "intervals done")

    drawn = _draw(config, workdir, figures, sensor, test, scores, shown, possible)
    logs = {TITLES[name]: _read_log(model_folder(workdir, name, config, split)) for name in MODELS[config.model]}
    drawn.append(figures / "training.png")
    evaluation.figures.training_curves(drawn[-1], logs)
    if split == config.splits[0] and len(data.full_trajectories()):
        drawn.append(figures / "strip.png")
        pictures.draw_strip(drawn[-1], config.collection, sensor, data)

    steps = {name: log[-1]["step"] if log else 0 for name, log in logs.items()}
    notes = [
        "Gradient steps: "
        + ", ".join(f"{name} {count}" for name, count in steps.items())
        + f", batch {_schedule(config).batch_size}.",
        f"Ceiling: {config.rerolls} re-rolls of the hidden values of each start. Touch can reveal a part of these "
        "values, and a model from touch can exceed it.",
    ]
    notes += _gains(TITLES[main_model(config)], scores, test)
    title = f"{workdir.name}: the last moment predicted from the first, held out by {split}"
    text = evaluation.table(summary, title=title, rows=main_rows(TITLES[main_model(config)], list(shown)), notes=notes)
    _files.write_bytes(table, text.encode())
    _files.write_bytes(complete, evaluation.full_table(summary, title=title, notes=notes).encode())
    results.write(done, {"split": split, **summary}, inputs, [table, complete, *drawn])
    return text


def judge_of(scenario: sts.physics.Scenario, train: dataset.Pairs) -> Callable[..., evaluation.Scores]:
    """`evaluation.score` for the outcomes of a scenario, as frequent as they are among some training trajectories."""
    frequency = evaluation.frequency(train.outcome, scenario.outcomes)
    return functools.partial(evaluation.score, outcomes=scenario.outcomes, frequency=frequency)


def main_model(config: Config) -> str:
    """The name of the model that the main table and the figures show."""
    return next(iter(MODELS[config.model]))


def number_of_samples(config: Config) -> int:
    """Samples of each prediction, or 0 for deterministic predictions."""
    return config.num_samples if config.model == "statespace" else 0


def _schedule(config: Config) -> TrainConfig:
    return config.state_training if config.model == "statespace" else config.training


def main_rows(model: str, titles: Sequence[str]) -> list[str]:
    """The rows of the main table, ten at most: the ceiling, the baselines, and the main model from five subsets.

    Args:
        model: Title of the main model.
        titles: Of the models' rows, in the order of `queries`.
    """
    first = [f"{model}, from {given}" for given in (*MAIN_SUBSETS, KNOWN)]
    return [evaluation.CEILING, *evaluation.BASELINES, *[title for title in first if title in titles][:5]]


def _gains(model: str, scores: Mapping[str, evaluation.Scores], test: dataset.Pairs) -> list[str]:
    """A line on the share of the outcome's log loss from vision that touch removes, if both were predicted."""
    before, after = (f"{model}, from {given}" for given in ("visual", "visual and tactile"))
    if before not in scores or after not in scores:
        return []
    found = evaluation.gain(scores[before], scores[after], test)
    if found is None:
        return []
    value, low, high = (found[key] for key in ("value", "low", "high"))
    return [f"Touch removes {value:.3f} [{low:.3f}, {high:.3f}] of the outcome's log loss from vision."]


def _draw(
    config: Config,
    workdir: Path,
    figures: Path,
    sensor: sts.Sensor,
    test: dataset.Pairs,
    scores: Mapping[str, evaluation.Scores],
    shown: Mapping[str, evaluation.Predicted],
    possible: Ceilings,
) -> list[Path]:
    """Draw the predictions of two queries and, of predicted distributions, their calibration and some ends."""
    drawn = []
    for given, name in (("visual", "predictions"), ("all inputs", "predictions-all")):
        query = f"{TITLES[main_model(config)]}, from {given}"
        if query not in shown:
            continue
        title = f"{workdir.name}, from {given}: the first {config.num_shown} of the held-out list"
        drawn.append(figures / f"{name}.png")
        evaluation.figures.predictions(
            drawn[-1],
            test,
            shown[query],
            num=config.num_shown,
            title=title,
            scenario=config.collection.scenario,
        )
        samples, rerolled = shown[query].samples, possible.pose[:, : config.num_shown]
        if samples is not None and samples.pose is not None:
            spread = np.linalg.norm(rerolled[..., :2] - rerolled[..., :2].mean(0), axis=-1).mean(0)
            item = int(spread.argmax())
            drawn.append(figures / f"{name.replace('predictions', 'ends')}.png")
            evaluation.figures.ends(
                drawn[-1],
                (float(sensor.gel.size[0]), float(sensor.gel.size[1])),
                test.pose[item, 0],
                test.pose[item, 1],
                rerolled[:, item],
                samples.pose[:, item],
                title=f"{workdir.name}, from {given}: ends of #{test.trajectory[item]}, the start with the widest "
                f"spread among the first {len(spread)}",
            )
    judged = {given: scores.get(f"{TITLES[main_model(config)]}, from {given}") for given in JUDGED_SUBSETS}
    known = {f"from {given}": own for given, own in judged.items() if own is not None and own.confidence is not None}
    if known:
        drawn.append(figures / "calibration.png")
        title = f"{workdir.name}: outcome probabilities of {TITLES[main_model(config)]}"
        evaluation.figures.calibration(drawn[-1], known, title=title)
    return drawn


def queries(config: Config, workdir: Path, split: str) -> Iterator[tuple[str, sts.Predictor, tuple[str, ...]]]:
    """Every model with every subset of the inputs it can be given, the empty one where it can be given none."""
    for name in MODELS[config.model]:
        predictor = sts.Predictor.load(model_folder(workdir, name, config, split))
        usable = predictor.modalities
        subsets = [s for n in range(1, len(usable) + 1) for s in itertools.combinations(usable, n)]
        for subset in subsets or [()]:
            if not subset:
                given = "no input: the first touch is always blank"
            elif len(usable) == 1:
                given = f"from {subset[0]}"
            else:
                given = "from all inputs" if subset == usable else f"from {' and '.join(subset)}"
            yield f"{TITLES[name]}, {given}", predictor, subset
        if config.model == "statespace" and "visual" in usable:
            yield f"{TITLES[name]}, from {KNOWN}", predictor, ("visual", "state")


def predict(
    scenario: sts.physics.Scenario,
    predictor: sts.Predictor,
    names: tuple[str, ...],
    validation: dataset.Pairs,
    test: dataset.Pairs,
    blank: np.ndarray,
    *,
    num_samples: int = 0,
) -> evaluation.Predicted:
    """The prediction of a model for the held-out trajectories.

    The outcome is that of the pose. With samples, its probabilities are the shares of the samples' outcomes, unless the
    model predicts them itself. The
    outcome of a model without a pose is read from whether its image is empty, in scenarios that only ask whether the
    object fell off. In other scenarios it has none.
    """

    def run(pairs: dataset.Pairs, num_samples: int) -> evaluation.Predicted:
        """Predict in calls of equal size, which bounds the memory. The last call repeats an item to be as long."""
        count = len(pairs.object)
        size, parts = min(count, CHUNK), []
        for number, start in enumerate(range(0, count, size)):
            rows = np.minimum(np.arange(start, start + size), count - 1)
            parts.append(_asked(predictor, names, pairs, rows, num_samples, number))
        return evaluation.first(evaluation.joined(parts), count)

    out = run(test, num_samples)
    if out.pose is not None:
        out = out._replace(outcome=evaluation.outcome_of_pose(scenario, test.pose[:, 0], out.pose))
    elif out.visual is not None and len(scenario.stays) == 1:
        score = evaluation.emptiness(np.asarray(run(validation, 0).visual), blank)
        threshold = evaluation.metrics.best_threshold(score, validation.outcome != int(sts.physics.Outcome.FELL_OFF))
        stays = int(scenario.stays[0])
        out = out._replace(outcome=evaluation.outcome_of_image(out.visual, blank, threshold, stays))
    if out.samples is not None and out.samples.pose is not None and out.outcome_probability is None:
        ends = np.stack([evaluation.outcome_of_pose(scenario, test.pose[:, 0], pose) for pose in out.samples.pose])
        out = out._replace(outcome_probability=evaluation.shares(ends, scenario.outcomes))
    return out


def _asked(
    predictor: sts.Predictor,
    names: tuple[str, ...],
    pairs: dataset.Pairs,
    rows: np.ndarray,
    num_samples: int,
    seed: int,
) -> evaluation.Predicted:
    """The prediction for some items, from the modalities `names`, with images of samples in `uint8`."""
    condition = pairs.condition[rows] if pairs.condition.shape[1] else None
    if names:
        out = predictor(
            visual=pairs.visual[rows, 0] / 255 if "visual" in names else None,
            tactile=pairs.tactile[rows, 0] / 255 if "tactile" in names else None,
            pose=pairs.pose[rows, 0] if "pose" in names else None,
            condition=condition,
            state=_true_states(predictor, pairs, rows) if "state" in names else None,
            key=jax.random.key(seed) if num_samples else None,
            num_samples=num_samples,
        )
    else:
        out = predictor.prior((len(rows),), condition=condition)
    found = (out.visual, out.tactile, out.pose, out.outcome_probability)
    visual, tactile, pose, probability = (None if leaf is None else np.asarray(leaf) for leaf in found)
    samples = None
    if out.samples is not None:
        images = (out.samples.visual, out.samples.tactile)
        drawn, felt = (None if leaf is None else np.round(255 * np.asarray(leaf)).astype(np.uint8) for leaf in images)
        samples = evaluation.Predicted(drawn, felt, None if out.samples.pose is None else np.asarray(out.samples.pose))
    return evaluation.Predicted(visual, tactile, pose, samples=samples, outcome_probability=probability)


def _true_states(predictor: sts.Predictor, pairs: dataset.Pairs, rows: np.ndarray) -> np.ndarray:
    return training.state_codes(
        predictor.preprocessing, pairs.pose[rows, 0], pairs.support[rows], pairs.mass[rows], pairs.com[rows]
    )


def _read_log(folder: Path) -> list[dict[str, float]]:
    path = folder / "metrics.jsonl"
    try:
        return [json.loads(line) for line in path.read_bytes().splitlines()]
    except FileNotFoundError:
        return []
    except ValueError as error:  # invalid UTF-8 or no JSON
        raise dataset.TornFileError(f"{path} is damaged ({error}): delete {folder} and train again.") from error
