"""The stages of an experiment: collect, train, evaluate. Each stage shows its progress and can be resumed."""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

import sts_jax as sts
from experiments.shared.config import MODELS, Config, check, main_model, model_folder
from experiments.shared.extensions import NONE, Extensions
from experiments.shared.judging import evaluate
from experiments.shared.progress import Bar, say
from sts_jax import dataset, evaluation, mvae, statespace, storage, training
from sts_jax.training import TrainConfig

Stage = Literal["collect", "train", "evaluate"]


def main(config: Config, workdir: Path, *, only: Stage | None = None, own: Extensions = NONE) -> None:
    """Collect the dataset, train the models, evaluate them, and print the main table.

    Args:
        config: Configuration of the experiment.
        workdir: Work directory for the results.
        only: Stage to run, with the results of the earlier stages in `workdir`. None: run all stages.
        own: Your own loss, optimiser, logger, metrics, modalities (field `measurements`) and notes.

    Raises:
        ValueError: A field of the configuration is out of range. The work directory has another configuration.
            `own.measurements` is not empty, but `config.model` is not "paper". A model in the work directory was
            trained with other values in `own`, as far as this can be detected.
        FileNotFoundError: A stage before `only` has not been run.
        LockedError: Another process works in the work directory.
    """
    check(config)
    if own.measurements and config.model != "paper":
        raise ValueError(
            f"measurements must be empty for model={config.model!r}, got the modality {own.measurements[0].name!r}: "
            "remove it, or use model='paper', because only the paper's model `mvae` accepts modalities in addition to "
            "visual, tactile and pose"
        )
    sensor = sts.Sensor()
    with storage.lock(workdir):
        claim(config, workdir)
        data = collect(config, workdir, sensor) if only in (None, "collect") else _collected(workdir)
        if only == "collect":
            return
        for split in config.splits:
            if only in (None, "train"):
                train(config, data, workdir, sensor, split, own)
            if only in (None, "evaluate"):
                _check_trained(config, workdir, split)
                print(evaluate(config, data, workdir, sensor, split, own))


def claim(config: Config, workdir: Path) -> None:
    """Write the configuration to `config.json`. If this file exists, check that it has the same configuration.

    Raises:
        ValueError: The work directory has another configuration. The message names the fields that differ.
    """
    storage.claim(workdir / "config.json", dataclasses.asdict(config))


def collect(config: Config, workdir: Path, sensor: sts.Sensor) -> dataset.Dataset:
    """Simulate and render the missing parts of the dataset, and open the dataset.

    Objects that cannot be simulated are listed in `objects.txt` in the work directory.
    """
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
        say(f"collect: {made.resampled} trajectories had non-finite values or sank into the pad and were drawn again")
    return dataset.load(workdir / "dataset")


def _collected(workdir: Path) -> dataset.Dataset:
    """Open the dataset of an earlier run.

    Raises:
        FileNotFoundError: There is no complete dataset.
    """
    if not (workdir / "dataset" / "collection.json").exists():
        raise FileNotFoundError(
            f"{workdir / 'dataset'} is not a collected dataset: first run the command with `--only collect`"
        )
    return dataset.load(workdir / "dataset")


def _check_trained(config: Config, workdir: Path, split: str) -> None:
    """Raise a `FileNotFoundError` unless all models of a split have been trained."""
    for name in MODELS[config.model]:
        folder = model_folder(workdir, name, config, split)
        if not (folder / "config.json").exists():
            raise FileNotFoundError(f"{folder} is not a trained model: first run the command with `--only train`")


def note(path: Path, lines: Sequence[str]) -> None:
    """Append lines to a text file, except lines that the file contains already."""
    there = path.read_text(errors="replace") if path.exists() else ""
    new = "".join(f"{line}\n" for line in lines if f"{line}\n" not in there)
    if new:
        storage.write_bytes(path, (there + new).encode())


class Job(NamedTuple):
    """The model and the data of one training."""

    name: str  # name of the model
    schedule: TrainConfig  # options of the training
    model: mvae.Config | statespace.Config  # configuration of the networks
    arrays: training.Arrays  # training data
    preprocessing: training.Preprocessing  # preprocessing of the inputs, which is stored with the model
    empty: dict[str, np.ndarray]  # image of the untouched sensor for each stream, uint8


def jobs(
    config: Config,
    sensor: sts.Sensor,
    pairs: dataset.Pairs,
    views: dataset.Views | None = None,
    falls: dataset.Ends | None = None,
    measurements: tuple[dataset.Measurement, ...] = (),
) -> Iterator[Job]:
    """Prepare the training of each model of an experiment.

    Args:
        config: Configuration of the experiment.
        sensor: Sensor with which the dataset was rendered.
        pairs: First and last frames of the training trajectories, with images at the resolution of the dataset.
        views: Further images of the training objects. Only the state-space model uses them.
        falls: First and last poses in trajectories of the training objects, without images. Only the state-space model
            uses these poses.
        measurements: Modalities of the paper's model `mvae` in addition to `visual`, `tactile` and `pose`. The other
            models do not use them. `pairs.measurements` must contain their values.
    """
    preprocessing, scenario = preprocessing_of(config), config.collection.scenario
    frame = dataset.empty_frame(sensor, config.collection)
    empty = {"visual": frame.visual, "tactile": frame.tactile}
    if config.model == "statespace":
        state, own = training.state_model(pairs, sensor, scenario, preprocessing, empty, image_size=config.image_size)
        arrays = training.state_arrays(pairs, state, scenario, own, empty, views=views, falls=falls)
        del pairs  # frees memory, because `arrays` contains copies of the same size
        yield Job("statespace", config.state_training, state, arrays, own, empty)
        return
    pairs, empty = dataset.reduced(pairs, config.image_size), dataset.reduced_images(empty, config.image_size)
    for number, (name, modalities) in enumerate(MODELS["paper"].items()):
        further = measurements if name == main_model(config) else ()
        arrays, own = training.frame_arrays(pairs, modalities, preprocessing, empty["tactile"], measurements=further)
        schedule = config.training
        if config.steps is not None:
            schedule = dataclasses.replace(schedule, steps=config.steps[number])
        model = training.paper_model(modalities, own, measurements=further)
        yield Job(name, schedule, model, arrays, own, empty)


def train(
    config: Config,
    data: dataset.Dataset,
    workdir: Path,
    sensor: sts.Sensor,
    split: str,
    own: Extensions = NONE,
) -> None:
    """Train the models of an experiment on one split, and show the progress.

    Args:
        config: Configuration of the experiment.
        data: Dataset of the experiment.
        workdir: Work directory for the models.
        sensor: Sensor of the collection.
        split: Split, one of `config.splits`.
        own: Your own loss, optimiser, logger and modalities.
    """
    rows, more = evaluation.rows_of(data, split)["train"], config.model == "statespace"
    views = data.views("train") if more else None
    falls = data.ends(data.members("train", rendered=False)) if more else None
    # The trajectories are passed without a variable of their own, so that `jobs` can free their memory.
    for job in jobs(
        config,
        sensor,
        data.pairs(rows, symmetries=True, measurements=own.measurements),
        views,
        falls,
        own.measurements,
    ):
        with Bar() as bar:

            def show(done: int, total: int, record: dict[str, float], bar: Bar = bar, name: str = job.name) -> None:
                bar(f"train {name}", done, total, f"loss {record['loss']:.4g}" if record else "")

            folder = model_folder(workdir, job.name, config, split)
            run(job, folder, config.targets, show, own)
            if isinstance(job.model, statespace.Config):
                validation = data.pairs(evaluation.rows_of(data, split)["validation"])
                calibrate(job, job.model, folder, config, validation)


def run(
    job: Job,
    folder: Path,
    targets: Literal["all", "own"],
    progress: Callable[[int, int, dict[str, float]], None],
    own: Extensions = NONE,
) -> None:
    """Train a model in a folder, or continue an interrupted training.

    Args:
        job: Model and data.
        folder: Folder of the model.
        targets: For the paper's models: modalities to predict from each subset of the inputs. "all": all modalities.
            "own": only the modalities in the subset. Ignored for the state-space model.
        progress: Function that is called after every step with the number of finished steps, the number of all steps,
            and the latest record of `metrics.jsonl` (empty before the first record).
        own: Your own loss, optimiser and logger.
    """
    training.save_blank(folder, job.empty["visual"], job.empty["tactile"])
    training.train(
        job.schedule,
        job.model,
        job.arrays,
        workdir=folder,
        absent=job.preprocessing.absent,
        targets=targets,
        preprocessing=dataclasses.asdict(job.preprocessing),
        loss=None if own.loss is None else own.loss(job.model),
        optimiser=own.optimiser,
        notes=own.notes,
        progress=progress,
        log=None if own.log is None else own.log(job.name),
    )


def calibrate(job: Job, model: statespace.Config, folder: Path, config: Config, validation: dataset.Pairs) -> None:
    """Calibrate a trained state-space model on the validation trajectories, and write `calibration.json`.

    The calibration corrects two predictions: the density of the pose, and the probabilities of the outcomes.

    Args:
        job: The training of the model, from `jobs`. Only its preprocessing and its images of the untouched sensor are
            used.
        model: Configuration of the networks, equal to `job.model`.
        folder: Folder of the trained model.
        config: Configuration of the experiment.
        validation: First and last frames of the validation trajectories.
    """
    arrays = training.state_arrays(validation, model, config.collection.scenario, job.preprocessing, job.empty)
    training.calibrate(folder, arrays)


def preprocessing_of(config: Config) -> training.Preprocessing:
    """Return the `training.Preprocessing` that belongs to the configuration of an experiment."""
    collection = config.collection
    small = (config.image_size, config.image_size)
    return training.Preprocessing(
        collection.resolution if config.model == "statespace" else small,
        collection.crop,
        rotation=config.rotation,
        mask_blank_touch=config.mask_blank_touch,
        condition_scale=collection.scenario.condition_scale,
    )
