"""Evaluates every model of an experiment with every subset of its inputs, and writes tables and figures."""

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import sts_jax as sts
from experiments.shared import drawing, pictures, results
from experiments.shared.config import MODELS, TITLES, Config, main_model, model_folder, schedule
from experiments.shared.extensions import NONE, Extensions
from experiments.shared.progress import Bar, say
from experiments.shared.rerolls import ceilings
from sts_jax import dataset, evaluation, storage, training
from sts_jax.dataset.measurement import NAMES
from sts_jax.training import records

# The main table has rows for the main model with the first five of these inputs that the model supports.
MAIN_SUBSETS = (
    *("visual", "tactile", "visual and tactile", "visual and pose", "all inputs", "pose"),
    evaluation.TRUE_STATE,
)


class SplitPairs(NamedTuple):
    """The first and last frames of the training, the validation and the held-out trajectories.

    The field `given` contains the held-out trajectories as inputs. The field `test` contains the same trajectories as
    targets. The images of `validation` and `given` have the resolution of the models' inputs. The images of `train` and
    `test` have the resolution `config.image_size`, in which predictions are scored.
    """

    train: dataset.Pairs  # training trajectories
    validation: dataset.Pairs  # validation trajectories
    given: dataset.Pairs  # held-out trajectories, as inputs
    test: dataset.Pairs  # the same held-out trajectories, as targets


def evaluate(
    config: Config,
    data: dataset.Dataset,
    workdir: Path,
    sensor: sts.Sensor,
    split: str,
    own: Extensions = NONE,
) -> str:
    """Score every model on held-out trajectories, write the results to files, and return the main table.

    The results are `metrics.json`, `table.md`, `table-full.md` and `figures/` in the work directory. `metrics.json`
    records the checksums of all inputs and results. While all checksums match, nothing is evaluated again. If `split`
    is not the first of `config.splits`, the names of the files contain the name of the split.

    Args:
        config: Configuration of the experiment.
        data: Dataset of the experiment.
        workdir: Work directory with the trained models.
        sensor: Sensor of the collection.
        split: Name of the split into training and held-out data, one of `config.splits`.
        own: Your own metrics, columns and modalities.

    Returns:
        The main table in Markdown.

    Raises:
        ValueError: The names of `own.measurements` differ from the names of the measurements with which the main model
            was trained. The main model is the model in `table.md`. `table-full.md` also contains the other trained
            models. A measurement is a modality besides images and pose, such as the contact force.
    """
    suffix = "" if split == config.splits[0] else f"-by-{split}"
    done, figures = workdir / f"metrics{suffix}.json", workdir / f"figures{suffix}"
    table, complete = workdir / f"table{suffix}.md", workdir / f"table-full{suffix}.md"
    inputs = _inputs(config, data, workdir, split, own)
    reason = results.stale(done, inputs)
    if reason is None:
        return table.read_text()
    if done.exists() or table.exists():
        say(f"evaluate: again, because {reason}")
    _check_measurements(model_folder(workdir, main_model(config), config, split), own)
    pairs, scenario = _pairs_of_split(config, data, split, own), config.collection.scenario
    judge, test = evaluation.scorer(scenario, pairs.train, metrics=own.scored), pairs.test
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
        metrics=own.metrics,  # re-rolls have no further modalities
    )
    references = evaluation.baselines(scenario, pairs.train, test)
    scores = {**possible.scores, **{title: judge(row, test) for title, row in references.items()}}
    with Bar() as bar:
        predicted, shown = _scored(config, workdir, split, pairs, judge, bar)
        scores |= predicted
        summary = evaluation.summarise(scores, test, metrics=own.scored, outcomes=scenario.outcomes)
        bar("evaluate", len(predicted), len(predicted), "intervals done")

    folders = {TITLES[name]: model_folder(workdir, name, config, split) for name in MODELS[config.model]}
    logs = {title: records.read(folder / records.NAME) for title, folder in folders.items()}
    drawn = drawing.draw(config, workdir, figures, sensor, test, scores, shown, possible)
    drawn.append(figures / "training.png")
    evaluation.figures.training_curves(drawn[-1], logs)
    if split == config.splits[0] and len(data.full_trajectories()):
        drawn.append(figures / "strip.png")
        pictures.draw_strip(drawn[-1], config.collection, sensor, data)

    title, notes = (
        f"{workdir.name}: the last frame predicted from the first, held out by {split}",
        _notes(config, logs),
    )
    notes += _gains(TITLES[main_model(config)], scores, test)
    rows = main_rows(TITLES[main_model(config)], list(shown))
    text = evaluation.table(summary, title=title, rows=rows, notes=notes, columns=own.columns)
    storage.write_bytes(table, text.encode())
    storage.write_bytes(complete, evaluation.full_table(summary, title=title, notes=notes, metrics=own.scored).encode())
    results.write(done, {"split": split, **summary}, inputs, [table, complete, *drawn])
    return text


def _inputs(config: Config, data: dataset.Dataset, workdir: Path, split: str, own: Extensions) -> dict[str, str]:
    """The checksums of the configuration, the dataset and the models, and of a user's own metrics and columns."""
    inputs = {"config.json": storage.digest(dataclasses.asdict(config)), "dataset": data.identity}
    for folder in (model_folder(workdir, name, config, split) for name in MODELS[config.model]):
        inputs[folder.relative_to(workdir).as_posix()] = results.identity(folder)
    if own.described() != NONE.described():
        inputs["the list of metrics"] = storage.digest(own.described())
    return inputs


def _check_measurements(folder: Path, own: Extensions) -> None:
    """Raise a `ValueError` unless `own.measurements` has the further modalities of the model in a folder."""
    trained = sorted(set(sts.Predictor.load(folder).modalities) - set(NAMES))
    given = sorted(measurement.name for measurement in own.measurements)
    if given != trained:
        raise ValueError(
            f"the names in measurements are {given}, but the model in {folder} was trained with {trained}: pass the "
            "same Extensions(measurements=...) as for the training, or train the model again in a new work directory"
        )


def _pairs_of_split(config: Config, data: dataset.Dataset, split: str, own: Extensions) -> SplitPairs:
    """Load the first and last frames of a split, in the resolutions that `SplitPairs` describes."""
    rows, further = evaluation.rows_of(data, split), own.measurements
    train = dataset.reduced(data.pairs(rows["train"], symmetries=True, measurements=further), config.image_size)
    validation, given = (data.pairs(rows[part], measurements=further) for part in ("validation", "test"))
    test = dataset.reduced(given, config.image_size)
    if config.model == "paper":
        validation, given = dataset.reduced(validation, config.image_size), test
    return SplitPairs(train, validation, given, test)


def queries(config: Config, workdir: Path, split: str) -> Iterator[tuple[str, sts.Predictor, tuple[str, ...]]]:
    """Combine each model with the subsets of its inputs that are scored (`evaluation.subsets`).

    Yields:
        The title of the row in the tables, the model, and the names of the inputs in the subset.
    """
    for name in MODELS[config.model]:
        predictor = sts.Predictor.load(model_folder(workdir, name, config, split))
        subsets = evaluation.subsets(predictor.modalities, state=config.model == "statespace")
        for given, subset in subsets.items():
            yield f"{TITLES[name]}, {given}", predictor, subset


def _scored(
    config: Config,
    workdir: Path,
    split: str,
    pairs: SplitPairs,
    judge: Callable[[evaluation.Predicted, dataset.Pairs], evaluation.Scores],
    bar: Bar,
) -> tuple[dict[str, evaluation.Scores], dict[str, evaluation.Predicted]]:
    """Predict with each combination of `queries`.

    Returns:
        The scores, and the first predictions for the figures, both by title.
    """
    blank = training.load_blank(model_folder(workdir, main_model(config), config, split))[0] / 255
    num_samples = config.num_samples if config.model == "statespace" else 0
    scores, shown = {}, {}
    jobs = list(queries(config, workdir, split))
    for number, (title, predictor, subset) in enumerate(jobs):
        bar("evaluate", number, len(jobs), title)
        row = evaluation.predict(
            predictor,
            subset,
            pairs.given,
            config.collection.scenario,
            validation=pairs.validation,
            blank=blank,
            num_samples=num_samples,
        )
        scores[title] = judge(row, pairs.test)
        shown[title] = evaluation.first(row, config.num_shown)
    return scores, shown


def main_rows(model: str, titles: Sequence[str]) -> list[str]:
    """Titles of the main table's rows: the ceiling, the baselines, and up to five rows of the main model.

    The row of the ceiling has the scores of a prediction that averages over re-rolls. A re-roll is another simulation
    from the same initial state, with new random hidden properties such as friction. Each row of the main model is for
    one set of inputs.

    Args:
        model: Title of the main model.
        titles: Titles of the rows of all models.
    """
    wanted = [f"{model}, from {given}" for given in MAIN_SUBSETS]
    return [evaluation.CEILING, *evaluation.BASELINES, *[title for title in wanted if title in titles][:5]]


def _notes(config: Config, logs: Mapping[str, Sequence[Mapping[str, float]]]) -> list[str]:
    """The notes below a table: the schedule of the training, and an explanation of the ceiling."""
    steps = ", ".join(f"{name} {log[-1]['step'] if log else 0}" for name, log in logs.items())
    return [
        f"Gradient steps: {steps}, batch {schedule(config).batch_size}.",
        f"Ceiling: {config.rerolls} re-rolls of the hidden values of each start. Touch can reveal a part of these "
        "values, and a model from touch can exceed it.",
    ]


def _gains(model: str, scores: Mapping[str, evaluation.Scores], test: dataset.Pairs) -> list[str]:
    """A note on the share by which touch lowers the log loss of the outcome, compared with vision alone.

    The list is empty if the main model did not predict outcomes from vision and from vision and touch.
    """
    before, after = (f"{model}, from {given}" for given in ("visual", "visual and tactile"))
    if before not in scores or after not in scores:
        return []
    found = evaluation.gain(scores[before], scores[after], test)
    if found is None:
        return []
    value, low, high = (found[key] for key in ("value", "low", "high"))
    return [f"Touch removes {value:.3f} [{low:.3f}, {high:.3f}] of the outcome's log loss from vision."]
