"""The stages that experiments share: collect, train, evaluate; each goes on where it stopped, with a progress bar."""

import dataclasses
import itertools
import json
import os
import tempfile
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Literal

import jax.numpy as jnp
import numpy as np
import tyro

import sts_jax as sts
from experiments import compilation
from experiments.progress import Bar, say
from sts_jax import dataset, evaluation, mvae, training

CACHE = Path(os.environ.get("XDG_CACHE_HOME", "~/.cache")).expanduser() / "sts_jax"  # what is made of mesh files
LEAST_OBJECTS = 10  # of a folder, so that whole ones can be held out to validate and to test
# The rows of the paper's Table 1, by the modalities a model has.
MODELS: dict[str, tuple[str, ...]] = {
    "mvae": ("visual", "tactile", "pose"),
    "mvae-without-pose": ("visual", "tactile"),
    "vae-visual": ("visual",),
    "vae-tactile": ("tactile",),
}
TITLES = {
    "mvae": "MVAE with pose",
    "mvae-without-pose": "MVAE without pose",
    "vae-visual": "VAE visual only",
    "vae-tactile": "VAE tactile only",
}


@dataclasses.dataclass(frozen=True)
class Config:
    """One experiment: what is collected, how it is learnt, how it is judged."""

    collection: dataset.Collection
    training: training.TrainConfig
    steps: tuple[int, ...] | None = None  # gradient steps of each of MODELS; None: training.epochs decide
    targets: Literal["all", "own"] = (
        "all"  # a subset of modalities is asked for "all" targets, or for its "own" (paper)
    )
    rotation: Literal["matrix", "quaternion"] = "matrix"  # as the networks see it
    mask_blank_touch: bool = True  # a touch without contact is no input; False: the blank image is fed (paper)
    # Held out: whole "object"s (70/10/20), or a fifth of the shuffled "trajectory"s, which shows each object on both
    # sides (paper). With several, each has its own models and table.
    splits: tuple[str, ...] = ("object",)
    num_shown: int = 8  # held-out trajectories in the figures


def smoke(default: Config) -> Config:
    """An experiment for tests: every stage, a little of each."""
    collection = dataclasses.replace(
        default.collection, num_objects=16, num_per_object=2, num_full=4, objects_per_shard=8, symmetries=False, seed=0
    )
    schedule = dataclasses.replace(default.training, batch_size=8, log_every=2, checkpoint_every=4)
    return dataclasses.replace(default, collection=collection, training=schedule, steps=(8, 8, 8, 8))


def paper(collection: dataset.Collection, *, num_objects: int, num_per_object: int) -> Config:
    """The paper's schedule and choices, on all frames of so many trajectories."""
    return Config(
        collection=dataclasses.replace(
            collection,
            num_objects=num_objects,
            num_per_object=num_per_object,
            num_full=num_objects * num_per_object,  # of about 60 frames of both streams
            symmetries=False,
            crop=True,
            objects_per_shard=20,
        ),
        training=training.TrainConfig(epochs=200, batch_size=64, learning_rate=1e-3),
        targets="own",
        rotation="quaternion",
        mask_blank_touch=False,
        splits=("trajectory", "object"),
    )


@dataclasses.dataclass(frozen=True)
class Args:
    """What the command line of an experiment says."""

    workdir: Path
    preset: Literal["smoke", "default", "paper"] = "default"
    plan: bool = False  # print seconds per stage from a short measurement, and stop
    hidden: sts.physics.Variant = "default"  # other hidden values, see physics.variant
    objects: Path | None = None  # a folder of meshes, or of ShapeNetSem, instead of procedural objects
    parts: bool = False  # what a hull fits badly collides as convex parts


def command(presets: Mapping[str, Config], workdir: str, description: str | None) -> None:
    """An experiment from the command line."""
    args = tyro.cli(Args, default=Args(Path(workdir)), description=description)
    compilation.keep()
    config = presets[args.preset]
    scenario = sts.physics.variant(config.collection.scenario, args.hidden)
    collection = dataclasses.replace(config.collection, scenario=scenario, parts=args.parts)
    if args.objects is not None:
        collection = with_meshes(collection, args.objects, args.workdir)
    config = dataclasses.replace(config, collection=collection)
    if args.plan:
        print(plan(config))
    else:
        main(config, args.workdir)


def with_meshes(collection: dataset.Collection, folder: Path, workdir: Path) -> dataset.Collection:
    """A collection of the objects of a folder, with about as many trajectories; lists them in `objects.txt`."""
    meshes, listing = dataset.survey_meshes(
        folder, collection.scenario, parts=collection.parts, cache=CACHE / "objects", progress=say
    )
    write(workdir / "objects.txt", listing.encode())
    say(f"{len(meshes.names)} objects can be used; {workdir / 'objects.txt'} has them and what was left out")
    if len(meshes.names) < LEAST_OBJECTS:
        raise ValueError(f"{folder}: {len(meshes.names)} objects are too few to hold some out: give {LEAST_OBJECTS}")
    each = max(collection.num_per_object, round(collection.num_trajectories / len(meshes.names)))
    return dataclasses.replace(collection, meshes=meshes, num_objects=len(meshes.names), num_per_object=each)


def main(config: Config, workdir: Path) -> None:
    """Collect, train, evaluate."""
    sensor = sts.Sensor()
    claim(config, workdir)
    data = collect(config, workdir, sensor)
    for split in config.splits:
        train(config, data, workdir, sensor, split)
        print(evaluate(config, data, workdir, sensor, split))


def claim(config: Config, workdir: Path) -> None:
    """Make a work directory this experiment's, or insist that it is."""
    dataset.claim(workdir / "config.json", dataclasses.asdict(config))


def collect(config: Config, workdir: Path, sensor: sts.Sensor) -> dataset.Dataset:
    """Make what is missing of the dataset and open it."""
    with Bar() as bar:
        made = dataset.collect(
            config.collection,
            sensor,
            workdir / "dataset",
            progress=lambda p: bar(f"collect: {p.stage}", p.done, p.total),
        )
    for line in made.left_out:
        say(f"collect: left out {line}")
    if made.resampled:
        say(f"collect: {made.resampled} trajectories went non-finite or sank and were drawn again")
    return dataset.load(workdir / "dataset")


def parts(data: dataset.Dataset, split: str) -> dict[str, np.ndarray]:
    """Which trajectories train, validate and test."""
    if split == "object":
        return {name: data.members(name) for name in ("train", "validation", "test")}
    if split != "trajectory":
        raise ValueError(f"unknown split {split!r}: hold out by 'object' or by 'trajectory'.")
    order = np.random.default_rng(data.collection["seed"]).permutation(len(data.trajectory["outcome"]))
    cut = round(0.8 * len(order))
    # The paper has no validation part; the outcome's threshold is then chosen on training trajectories.
    return {"train": np.sort(order[:cut]), "validation": np.sort(order[:cut]), "test": np.sort(order[cut:])}


def model_folder(workdir: Path, name: str, config: Config, split: str) -> Path:
    """Where a model lives: `models/NAME`, with the split behind it where it is not the experiment's first."""
    return workdir / "models" / (name if split == config.splits[0] else f"{name}-by-{split}")


def train(config: Config, data: dataset.Dataset, workdir: Path, sensor: sts.Sensor, split: str) -> None:
    """Train the models of the paper's Table 1 on one split."""
    pairs = data.pairs(parts(data, split)["train"], symmetries=True)
    blank = empty_frame(sensor, config.collection)
    for number, (name, modalities) in enumerate(MODELS.items()):
        arrays, preprocessing = learnable(pairs, modalities, preprocessing_of(config), blank.tactile)
        schedule = config.training
        if config.steps is not None:
            schedule = dataclasses.replace(schedule, steps=config.steps[number])
        folder = model_folder(workdir, name, config, split)
        training.save_blank(folder, blank.visual, blank.tactile)
        with Bar() as bar:

            def show(done: int, total: int, record: dict[str, float], bar: Bar = bar, name: str = folder.name) -> None:
                bar(f"train {name}", done, total, f"loss {record['loss']:.4g}" if record else "")

            training.train(
                schedule,
                model_config(modalities, preprocessing),
                arrays,
                workdir=folder,
                absent=preprocessing.absent,
                targets=config.targets,
                preprocessing=dataclasses.asdict(preprocessing),
                progress=show,
            )


def preprocessing_of(config: Config) -> training.Preprocessing:
    """How an experiment's measurements are made ready for the networks."""
    collection = config.collection
    return training.Preprocessing(
        collection.resolution,
        collection.crop,
        rotation=config.rotation,
        mask_blank_touch=config.mask_blank_touch,
        condition_scale=collection.scenario.condition_scale,
    )


def model_config(modalities: tuple[str, ...], preprocessing: training.Preprocessing) -> mvae.Config:
    """The paper's networks for some modalities; lambda is 1 for images and 1000 for the pose."""
    pose = mvae.Modality("pose", "vector", (preprocessing.pose_size,), weight=1000.0)
    shape = (*preprocessing.resolution, 3)
    images = {name: mvae.Modality(name, "image", shape, start=0.7) for name in ("visual", "tactile")}
    kept = tuple({**images, "pose": pose}[name] for name in modalities)
    return mvae.Config(kept, condition=len(preprocessing.condition_scale))


def learnable(
    pairs: dataset.Pairs, modalities: tuple[str, ...], preprocessing: training.Preprocessing, blank: np.ndarray
) -> tuple[training.Arrays, training.Preprocessing]:
    """First moments as inputs, last ones as targets, and which inputs no trajectory has."""
    code = np.asarray(preprocessing.encode_pose(jnp.asarray(pairs.pose)))
    moments = {"visual": pairs.visual, "tactile": pairs.tactile, "pose": code}
    condition = np.asarray(preprocessing.encode_condition(jnp.asarray(pairs.condition)))
    touched = np.asarray(
        preprocessing.touched(jnp.asarray(pairs.tactile[:, 0] / 255, jnp.float32), jnp.asarray(blank / 255))
    )
    absent = ("tactile",) if "tactile" in modalities and not touched.any() else ()
    arrays = training.Arrays(
        inputs={name: np.ascontiguousarray(moments[name][:, 0]) for name in modalities if name not in absent},
        targets={name: np.ascontiguousarray(moments[name][:, 1]) for name in modalities},
        present={"tactile": touched} if "tactile" in modalities and not absent else {},
        condition=condition if condition.shape[1] else None,
    )
    return arrays, dataclasses.replace(preprocessing, absent=absent)


def empty_frame(sensor: sts.Sensor, collection: dataset.Collection) -> dataset.Images:
    """Both streams with nothing on the sensor, `uint8`."""
    body = dataset.make_bodies(collection, np.array([0]))[0]
    gone = jnp.array([[0.0, 0, -1, 1, 0, 0, 0]])
    images = dataset.render_uint8(
        sensor, body, gone, jnp.zeros((1, 6)), resolution=collection.resolution, crop=collection.crop
    )
    return dataset.Images(*(np.asarray(leaf)[0] for leaf in images))


def evaluate(config: Config, data: dataset.Dataset, workdir: Path, sensor: sts.Sensor, split: str) -> str:
    """Score every model on held-out trajectories; write `metrics.json`, `table.md` and `figures/`; return the table."""
    suffix = "" if split == config.splits[0] else f"-by-{split}"
    done = workdir / f"table{suffix}.md"
    if done.exists():
        return done.read_text()
    part = parts(data, split)
    train_pairs, validation, test = (
        data.pairs(part["train"], symmetries=True),
        data.pairs(part["validation"]),
        data.pairs(part["test"]),
    )
    blank = training.load_blank(model_folder(workdir, "mvae", config, split))[0] / 255
    rows = evaluation.baselines(config.collection.scenario, train_pairs, test)
    with Bar() as bar:
        jobs = list(queries(config, workdir, split))
        for number, (title, predictor, names) in enumerate(jobs):
            bar("evaluate", number, len(jobs), title)
            rows[title] = predict(config.collection.scenario, predictor, names, validation, test, blank)
        scores = {title: evaluation.score(row, test) for title, row in rows.items()}
        summary = evaluation.summarise(scores, test)
        bar("evaluate", len(jobs), len(jobs), "intervals done")

    figures = workdir / f"figures{suffix}"
    both, single = f"{TITLES['mvae']}, from all inputs", f"{TITLES['mvae']}, from visual"
    shown = {"MVAE from vision": rows[single]}
    if both in rows:
        shown["MVAE from all"] = rows[both]
    title = f"{workdir.name}: the first {config.num_shown} of the held-out list, by {split}"
    if config.collection.scenario.condition_scale:
        title += "; red: where to, and how hard, the jerk drives it"
    evaluation.figures.predictions(figures / "predictions.png", test, shown, num=config.num_shown, title=title)
    category = np.array(dataset.class_names(config.collection))[test.object]
    best = rows[both] if both in rows else rows[single]
    assert best.pose is not None  # "mvae" of MODELS has one
    first = np.sort(np.unique(test.object, return_index=True)[1])[:10]  # the first one of each of the first objects
    samples = [dataset.sample_of_class(config.collection, name) for name in category[first]]
    stands = evaluation.stand_ins(sensor, samples, best.pose[first], config.collection.resolution)
    line_up = figures / "line_up.png"
    evaluation.figures.line_up(line_up, line_up.with_suffix(".json"), test, best, category, blank, stands, first)
    logs = {TITLES[name]: _read_lines(model_folder(workdir, name, config, split) / "metrics.jsonl") for name in MODELS}
    evaluation.figures.training_curves(figures / "training.png", logs)
    if split == config.splits[0]:
        draw_strip(config, data, figures / "strip.png", sensor)

    steps = {name: log[-1]["step"] if log else 0 for name, log in logs.items()}
    notes = [
        "Gradient steps: "
        + ", ".join(f"{name} {count}" for name, count in steps.items())
        + f"; batch {config.training.batch_size}.",
    ]
    content = (json.dumps({"split": split, **summary}, indent=2) + "\n").encode()
    write(workdir / f"metrics{suffix}.json", content)
    title = f"{workdir.name}: the last moment predicted from the first, held out by {split}"
    text = evaluation.table(summary, title=title, notes=notes)
    write(done, text.encode())
    return text


def queries(config: Config, workdir: Path, split: str) -> Iterator[tuple[str, sts.Predictor, tuple[str, ...]]]:
    """Every model with every subset of the inputs it can be given, the empty one where it can be given none."""
    for name in MODELS:
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


def predict(
    scenario: sts.physics.Scenario,
    predictor: sts.Predictor,
    names: tuple[str, ...],
    validation: dataset.Pairs,
    test: dataset.Pairs,
    blank: np.ndarray,
) -> evaluation.Predicted:
    """What a model says of the held-out trajectories.

    Its outcome is that of its pose. Of a model without one it is whether its image is empty, where `scenario` asks for
    no more than whether the object fell off; else it is left open.
    """

    def run(pairs: dataset.Pairs) -> evaluation.Predicted:
        condition = pairs.condition if pairs.condition.shape[1] else None
        out = (
            predictor(
                visual=pairs.visual[:, 0] / 255 if "visual" in names else None,
                tactile=pairs.tactile[:, 0] / 255 if "tactile" in names else None,
                pose=pairs.pose[:, 0] if "pose" in names else None,
                condition=condition,
            )
            if names
            else predictor.prior((len(pairs.object),), condition=condition)
        )
        return evaluation.Predicted(
            *(None if leaf is None else np.asarray(leaf) for leaf in (out.visual, out.tactile, out.pose))
        )

    out, outcome = run(test), None
    if out.pose is not None:
        outcome = evaluation.outcome_of_pose(scenario, test.pose[:, 0], out.pose)
    elif out.visual is not None and len(scenario.outcomes) == 2:
        score = evaluation.emptiness(np.asarray(run(validation).visual), blank)
        threshold = evaluation.metrics.best_threshold(score, validation.outcome != int(sts.physics.Outcome.FELL_OFF))
        outcome = evaluation.outcome_of_image(out.visual, blank, threshold)
    return out._replace(outcome=outcome)


def plan(config: Config, *, num: int = 64, steps: int = 4) -> str:
    """Seconds a stage, measured on a little of each and everything twice, so that compilation counts once.

    Args:
        config: The experiment.
        num: Trajectories to simulate; each has its first and last frame rendered in all symmetries.
        steps: Gradient steps of each model.

    Returns:
        One line a stage.
    """
    sensor, collection = sts.Sensor(), config.collection
    many = 8  # objects
    lines = []
    with tempfile.TemporaryDirectory() as name, Bar() as bar:
        spent: dict[str, list[float]] = {"trajectories": [], "frames": []}
        for seed in (0, 1):
            little = dataclasses.replace(
                dataset.head(collection, many), num_per_object=num // many, num_full=0, symmetries=True, seed=seed
            )
            stamps = {"start": time.perf_counter()}

            def watch(progress: dataset.Progress, stamps: dict[str, float] = stamps) -> None:
                stamps[progress.stage] = time.perf_counter()
                bar(f"plan: {progress.stage}", progress.done, progress.total)

            dataset.collect(little, sensor, Path(name) / str(seed), progress=watch)
            spent["trajectories"].append(stamps["trajectories"] - stamps["start"])
            spent["frames"].append(stamps["frames"] - stamps["trajectories"])
        last, seen = collection.scenario.frames, len(dataset.symmetries_of(collection))
        ends = collection.num_trajectories * 2 * seen
        frames = ends + min(collection.num_full, collection.num_trajectories) * (last - 2)
        for stage, total, measured in (
            ("trajectories", collection.num_trajectories, num),
            ("frames", frames, 2 * len(collection.scenario.symmetries) * num),
        ):
            first, again = spent[stage]
            rate = measured / again
            seconds = max(first - again, 0) + total / rate
            lines.append(
                (f"collect: {total} {stage}", seconds, f"{rate:.3g} a second, {first - again:.0f} s to compile")
            )

        data = dataset.load(Path(name) / "0")
        tiny = dataclasses.replace(config, collection=dataset.head(collection, many), splits=("trajectory",))
        pairs = data.pairs(np.arange(num), symmetries=True)
        blank = empty_frame(sensor, collection)
        share = 0.7 if config.splits[0] == "object" else 0.8
        samples = round(share * collection.num_trajectories) * seen
        for number, (model, modalities) in enumerate(MODELS.items()):
            arrays, preprocessing = learnable(pairs, modalities, preprocessing_of(config), blank.tactile)
            stamps_of_steps = [time.perf_counter()]

            def tick(done: int, total: int, _: dict, stamps: list[float] = stamps_of_steps, model: str = model) -> None:
                stamps.append(time.perf_counter())
                bar(f"plan: train {model}", done, total)

            training.train(
                dataclasses.replace(config.training, steps=steps, log_every=1, checkpoint_every=steps),
                model_config(modalities, preprocessing),
                arrays,
                workdir=model_folder(Path(name), model, tiny, "trajectory"),
                absent=preprocessing.absent,
                targets=config.targets,
                preprocessing=dataclasses.asdict(preprocessing),
                progress=tick,
            )
            training.save_blank(model_folder(Path(name), model, tiny, "trajectory"), blank.visual, blank.tactile)
            each = float(np.median(np.diff(stamps_of_steps)[1:]))
            compiling = stamps_of_steps[1] - stamps_of_steps[0] - each
            total = config.steps[number] if config.steps is not None else config.training.total(samples)
            note = f"{each:.3g} s a step, {compiling:.0f} s to compile"
            lines.append((f"train {model}: {total} steps", compiling + total * each, note))
        start = time.perf_counter()
        evaluate(tiny, data, Path(name), sensor, "trajectory")
        lines.append(("evaluate and draw", time.perf_counter() - start, f"of {round(0.2 * num)} trajectories"))
    repeats = len(config.splits)
    lines = [(what, seconds * (1 if what.startswith("collect") else repeats), note) for what, seconds, note in lines]
    lines.append(("together", sum(seconds for _, seconds, _ in lines), f"for {', '.join(config.splits)} split"))
    return "\n".join(f"{what:<36}{seconds:>9.0f} s   ({note})" for what, seconds, note in lines)


def draw_strip(config: Config, data: dataset.Dataset, path: Path, sensor: sts.Sensor) -> None:
    """A fully rendered trajectory, the first with the most telling outcome, from outside and through the sensor."""
    full = data.full_trajectories()
    if not len(full):
        return
    rank = [config.collection.scenario.outcomes.index(o) for o in data.trajectory["outcome"][full]]
    index = int(full[np.argmin(rank)])
    one, hidden = ({name: leaf[index] for name, leaf in x.items()} for x in (data.trajectory, data.hidden))
    images = data.strip(index)
    body = dataset.make_bodies(config.collection, np.array([one["body"]]))[0]
    what = describe(dataset.class_names(config.collection)[one["body"]], one, hidden)
    evaluation.figures.strip(
        path,
        one["time"],
        views(body, one["pose"], one["gravity"], sensor, config.collection.scenario.wall),
        images.visual / 255,
        images.tactile / 255,
        one["wrench"],
        title=f"trajectory {index}: {what}",
    )


def views(body: sts.objects.Body, pose: np.ndarray, gravity: np.ndarray, sensor: sts.Sensor, wall: float) -> np.ndarray:
    """A trajectory from outside, `(frames, h, w, 3)` in [0, 1], with the gravity of its end drawn downwards.

    What fell off and was frozen is no longer drawn.
    """
    size, up = jnp.array(sensor.gel.size), -jnp.asarray(gravity[-1])
    frozen = np.append(False, (pose[1:] == pose[:-1]).all(1)) & np.asarray(sts.physics.fell_off(jnp.asarray(pose)))
    pose = np.where(frozen[:, None], np.array([0, 0, -10, 1, 0, 0, 0], np.float32), pose)
    return np.stack([np.asarray(evaluation.outside(body, jnp.asarray(each), size, up, wall)) for each in pose])


def describe(name: str, trajectory: Mapping[str, np.ndarray], hidden: Mapping[str, np.ndarray]) -> str:
    """One trajectory in words: class, outcome, hidden values and condition, from leaves of `physics.Trajectory`."""
    outcome = sts.physics.Outcome(int(trajectory["outcome"])).name.lower().replace("_", " ")
    words = [f"a {name} {outcome}"]
    words += [f"{key.replace('_', ' ')} {hidden[key]:.2f}" for key in ("fill", "shell_scale", "friction")]
    if hidden["up"][2] < 1:
        words.append("contents' up ({:.1f}, {:.1f}, {:.1f})".format(*hidden["up"]))
    if len(trajectory["condition"]):
        x, y, duration = trajectory["condition"]
        words.append(f"pad jerked by ({x:.1f}, {y:.1f}) m/s² for {1e3 * duration:.0f} ms")
    return ", ".join(words)


def _read_lines(path: Path) -> list[dict[str, float]]:
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def write(path: Path, data: bytes) -> None:
    """A whole file or none."""
    dataset.write_whole(path, lambda temporary: _write_bytes(temporary, data))


def _write_bytes(path: Path, data: bytes) -> None:
    path.write_bytes(data)
