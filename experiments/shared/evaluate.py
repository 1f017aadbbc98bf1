"""Evaluates every model of an experiment with every subset of its inputs, and records what the results belong to."""

import contextlib
import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

import sts_jax as sts
from experiments.shared import drawing
from experiments.shared.config import MODELS, NONE, TITLES, Extensions, Run
from experiments.shared.terminal import Bar, say
from sts_jax import dataset, evaluation, storage, training

# The main table has rows for the main model with the first five of these inputs that the model supports.
MAIN_SUBSETS = (
    *("visual", "tactile", "visual and tactile", "visual and pose", "all inputs", "pose"),
    evaluation.TRUE_STATE,
)
# Metrics that are printed at the end, with further metrics of your own.
PRINTED = ("visual_skill", "tactile_skill", "position_on_pad")
SEED = 20  # seed of the re-rolls

Judge = Callable[[evaluation.Predicted, dataset.Pairs], evaluation.Scores]


@dataclasses.dataclass(frozen=True)
class Part:
    """A part of the results in a manifest: checksums of its inputs by name, and the names of its files."""

    inputs: dict[str, str]
    files: tuple[str, ...]


def stale(folder: Path, part: str, inputs: Mapping[str, str]) -> str | None:
    """Why a part of the results of a folder must be computed again, given the checksums of its inputs, or None."""
    try:
        manifest = storage.read_manifest(folder, "it will be written again")
        recorded = _parts(manifest).get(part)
        if manifest is None or recorded is None:
            return f"{storage.MANIFEST} has no record of the {part}"
        for name in {**recorded.inputs, **inputs}:
            if recorded.inputs.get(name) != inputs.get(name):
                return f"{name} has changed since"
        storage.verify(folder, manifest, "it will be written again", recorded.files)
    except storage.DamagedFileError as error:
        return str(error)
    return None


def record(folder: Path, part: str, inputs: Mapping[str, str], files: Sequence[Path]) -> None:
    """Add the inputs and the files of a part of the results to the manifest of a folder. Call it after writing them."""
    before = None
    with contextlib.suppress(storage.DamagedFileError):
        before = storage.read_manifest(folder, "")
    names = [file.relative_to(folder).as_posix() for file in files]
    parts = {**_parts(before), part: Part(dict(inputs), tuple(names))}
    sums = {**(before.files if before else {}), **storage.checksums(folder, names)}
    kept = {name: sums[name] for one in parts.values() for name in one.files if name in sums}
    storage.write_manifest(folder, kept, {name: dataclasses.asdict(one) for name, one in parts.items()})


def _parts(manifest: storage.Manifest | None) -> dict[str, Part]:
    """The parts of the results that a manifest records. Facts of other folders are left out."""
    parts, (files, facts) = {}, manifest or storage.Manifest({}, {})
    for name, fact in facts.items():
        if not isinstance(fact, dict) or "files" not in fact:  # an older record, whose part has all files
            fact = {"inputs": fact, "files": list(files)}
        with contextlib.suppress(ValueError):
            parts[name] = storage.decode(Part, fact, name)
    return parts


def identity(model: Path) -> str:
    """SHA-256 that changes with every file of a model: its manifest has their checksums, and its log is short."""
    names = ("manifest.json", "metrics.jsonl")
    return storage.digest({name: storage.sha256(model / name) for name in names if (model / name).exists()})


class SplitPairs(NamedTuple):
    """The first and last frames of the parts of a split.

    `validation` and `given` have the resolution of the models' inputs, `train` and `test` have `config.image_size`.
    """

    train: dataset.Pairs  # training trajectories
    validation: dataset.Pairs  # validation trajectories
    given: dataset.Pairs  # held-out trajectories, as inputs
    test: dataset.Pairs  # the same held-out trajectories, as targets
    rows: Mapping[str, np.ndarray]  # indices of the trajectories in each part of the split


def evaluate(run: Run, data: dataset.Dataset, own: Extensions = NONE) -> str:
    """Score every model on held-out trajectories, write the results, and return a short text for the terminal.

    While the checksums of all inputs and results match those in `manifest.json`, nothing is evaluated again.
    """
    config, workdir, scenario = run.config, run.workdir, run.config.collection.scenario
    part, inputs = f"evaluation by {run.split}", _inputs(run, data, own)
    metrics, table, complete = (
        workdir / name for name in (f"metrics{run.suffix}.json", f"table{run.suffix}.md", f"table-full{run.suffix}.md")
    )
    reason = stale(workdir, part, inputs)
    if reason is None:
        return _ending(run, storage.read_json(metrics, f"delete {metrics}"), own)
    if metrics.exists() or table.exists():
        say(f"evaluate: again, because {reason}")
    pairs = _pairs(run, data, own)
    test, judge = pairs.test, evaluation.scorer(scenario, pairs.train, metrics=own.scored)
    with Bar() as bar:
        few = test.take(slice(config.num_rerolled))
        items = evaluation.figures.one_of_each(few, dataset.class_names(config.collection), config.num_shown)
        predicted, shown = _scored(run, pairs, judge, items, bar)
        total = config.rerolls * len(few.object)
        rerolls, rerolled = reroll(run, few, judge, lambda done: bar("re-roll", done, total))
        baselines = evaluation.baselines(scenario, pairs.train, test)
        scores = {**rerolls, **{title: judge(row, test) for title, row in baselines.items()}, **predicted}
        summary = evaluation.summarise(scores, test, metrics=own.scored, outcomes=scenario.outcomes)
        bar("evaluate", len(predicted), len(predicted), "intervals done")

    logs = {TITLES[name]: training.records(run.folder(name)) for name in MODELS[config.model]}
    figures = drawing.draw(run, pairs.given.take(items), scores, shown, rerolled[:, items])
    figures.append(run.figures / "training.png")
    evaluation.figures.training_curves(figures[-1], logs)
    if not run.suffix and len(data.full_trajectories()):
        figures.append(run.figures / "strip.png")
        drawing.draw_strip(figures[-1], config.collection, run.sensor, data)

    model = TITLES[run.main_model]
    title = f"{workdir.name}: the last frame predicted from the first, held out by {run.split}"
    notes = _notes(run, logs, scores, test)
    text = evaluation.table(summary, title=title, rows=main_rows(model, list(shown)), notes=notes, columns=own.columns)
    full = evaluation.full_table(summary, title=title, notes=notes, metrics=own.scored)
    storage.write_bytes(table, text.encode())
    storage.write_bytes(complete, full.encode())
    storage.write_json(metrics, {"split": run.split, **summary})
    record(workdir, part, inputs, [metrics, table, complete, *figures])
    return _ending(run, summary, own)


def _ending(run: Run, summary: dict, own: Extensions) -> str:
    """What the terminal shows at the end: a short table, where the results are, and what to do next."""
    rows = main_rows(TITLES[run.main_model], list(summary["predictors"]))
    shown = [metric for metric in own.scored if metric.name in PRINTED or metric not in evaluation.METRICS]
    return "\n".join(
        [
            f"{run.workdir.name}: {summary['items']} trajectories of {summary['objects']} objects, held out by "
            f"{run.split}. Skill is 0 for the mean image and 1 for the true image",
            evaluation.short_table(summary, rows=rows, metrics=shown),
            f"tables:  {run.workdir / f'table{run.suffix}.md'} explains the metrics, table-full{run.suffix}.md has all",
            f"figures: {run.figures}",
            f'next:    sts.Predictor.load("{run.folder(run.main_model)}") in Python predicts from images',
        ]
    )


def _inputs(run: Run, data: dataset.Dataset, own: Extensions) -> dict[str, str]:
    """The checksums of the configuration, the dataset, the models, and the names of the metrics and the columns."""
    names = [metric.name for metric in own.scored], [column.heading for column in own.columns]
    contents = {"config.json": dataclasses.asdict(run.config), "the list of metrics": names}
    models = {f"models/{name}{run.suffix}": identity(run.folder(name)) for name in MODELS[run.config.model]}
    return {"dataset": data.identity, **models, **{name: storage.digest(x) for name, x in contents.items()}}


def _pairs(run: Run, data: dataset.Dataset, own: Extensions) -> SplitPairs:
    rows, size, further = evaluation.rows_of(data, run.split), run.config.image_size, own.measurements
    train = dataset.reduced(data.pairs(rows["train"], measurements=further), size)
    validation, given = (data.pairs(rows[part], measurements=further) for part in ("validation", "test"))
    test = dataset.reduced(given, size)
    if run.config.model == "paper":
        validation, given = dataset.reduced(validation, size), test
    return SplitPairs(train, validation, given, test, rows)


def _scored(
    run: Run, pairs: SplitPairs, judge: Judge, items: np.ndarray, bar: Bar
) -> tuple[dict[str, evaluation.Scores], dict[str, evaluation.Predicted]]:
    """The scores of each model for each subset of its inputs, and the predictions of `items`, by title of the row."""
    config, state, jobs = run.config, run.config.model == "statespace", []
    for name in MODELS[config.model]:
        predictor = sts.Predictor.load(run.folder(name))
        training.claim_split(run.folder(name), pairs.rows)
        for given, subset in evaluation.subsets(predictor.modalities, state=state).items():
            jobs.append((f"{TITLES[name]}, {given}", predictor, subset))
    blank = training.load_blank(run.folder(run.main_model))[0] / 255
    scores, shown = {}, {}
    for number, (title, predictor, subset) in enumerate(jobs):
        bar("evaluate", number, len(jobs), title)
        row = evaluation.predict(
            predictor,
            subset,
            pairs.given,
            config.collection.scenario,
            validation=pairs.validation,
            blank=blank,
            num_samples=config.num_samples if state else 0,
        )
        scores[title] = judge(row, pairs.test)
        shown[title] = evaluation.take(row, items)
    return scores, shown


def main_rows(model: str, titles: Sequence[str]) -> list[str]:
    """Titles of the main table's rows: the ceiling, the baselines, and up to five rows of the main model."""
    wanted = [f"{model}, from {given}" for given in MAIN_SUBSETS]
    return [evaluation.CEILING, *evaluation.BASELINES, *[title for title in wanted if title in titles][:5]]


def _notes(
    run: Run, logs: Mapping[str, Sequence[Mapping]], scores: Mapping[str, evaluation.Scores], test: dataset.Pairs
) -> list[str]:
    """The notes below a table: the schedule of the training, the ceiling, and what touch adds to vision."""
    steps = ", ".join(f"{name} {log[-1]['step'] if log else 0:.0f}" for name, log in logs.items())
    notes = [
        f"Gradient steps: {steps}, batch {run.config.schedule.batch_size}.",
        f"Ceiling: {run.config.rerolls} re-rolls of the hidden values of each start. Touch can reveal a part of these "
        "values, and a model from touch can exceed it.",
    ]
    rows = [f"{TITLES[run.main_model]}, from {given}" for given in ("visual", "visual and tactile")]
    if all(row in scores for row in rows) and (gain := evaluation.gain(scores[rows[0]], scores[rows[1]], test)):
        interval = evaluation.metrics.written(**gain, digits=3)
        notes.append(f"Touch removes {interval} of the outcome's log loss from vision.")
    return notes


def reroll(
    run: Run, test: dataset.Pairs, judge: Judge, progress: Callable[[int], object]
) -> tuple[dict[str, evaluation.Scores], np.ndarray]:
    """Re-roll trajectories. Returns the scores of the mean and of one of the re-rolls, and the poses (times, n, 7)."""
    key, times = jax.random.key(SEED), run.config.rerolls
    mean = evaluation.ceiling(run.config.collection, run.sensor, test, times, key, progress=progress)
    samples = mean.samples
    assert samples is not None
    assert samples.pose is not None
    one = evaluation.Predicted(*(None if leaf is None else leaf[0] for leaf in samples[:4]))
    return {evaluation.CEILING: judge(mean, test), evaluation.ONE_REROLL: judge(one, test)}, samples.pose
