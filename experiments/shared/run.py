"""An experiment from its command line to its results: collect, train, evaluate. Each stage can be resumed."""

import argparse
import dataclasses
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Literal, NamedTuple, TypeVar

import jax.numpy as jnp
import numpy as np
import tyro

import sts_jax as sts
from experiments.shared.config import MODELS, NONE, Config, Extensions, Run, check
from experiments.shared.datasets import collect, finished, link
from experiments.shared.evaluate import evaluate
from experiments.shared.terminal import Bar, on_one_line, say
from sts_jax import dataset, evaluation, mvae, statespace, storage, training
from sts_jax.compilation import cache_folder
from sts_jax.training import TrainConfig

Stage = Literal["collect", "train", "evaluate"]
Skin = Literal["hazy", "clear"]
Preset = TypeVar("Preset")  # type of a configuration
_VALIDATION = 10  # of the training trajectories of a split by trajectory, every 10th is for validation
# Fields of the configuration that have no effect on the training of each kind of models
WITHOUT_EFFECT = {
    "statespace": ("training", "steps", "targets", "encode_condition", "prior"),
    "paper": ("state_training", "num_samples"),
}


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of the command line of an experiment."""

    workdir: Path  # folder for the results
    # configuration of the preset. Each of its fields is an option
    config: Annotated[Config, tyro.conf.arg(name="")]
    preset: Literal["smoke", "default", "long", "paper"] = "default"  # set of default values for the options
    only: Stage | None = None  # run only this stage of the experiment
    # ranges of the hidden properties fill, shell mass and friction: those of the scenario (default), only the middle of
    # each range (off), a wider range of friction (wide-friction), or contents that may lie on any side of the
    # object (off-centre)
    hidden: sts.physics.Variant = "default"
    # skin of the sensor, which the camera looks through: the sensor's default (hazy), or one without haze, scattered
    # light, tint and shadows, as in the paper's code (clear)
    skin: Skin = "hazy"
    objects: Path | None = None  # folder of mesh files or of ShapeNetSem, whose objects replace the procedural ones
    # classes of the objects. Empty: those of the experiment, or all classes of --objects if it has none of these
    classes: tuple[str, ...] = ()
    # length of one unit of the files in --objects (m), such as 0.001 for millimetres, or files and sub-folders, each
    # followed by its own: --scale gripper 0.001 "*.glb" 1. None: that of ShapeNetSem's table, or 1 m
    scale: float | dict[str, float] | None = None
    # axis of the files in --objects that points up. None: that of ShapeNetSem's table, or y for glTF and z for other
    # files
    up: Literal["x", "y", "z"] | None = None
    parts: bool = False  # decompose an object into convex parts if its convex hull fits badly
    # folder or URL of a finished dataset (of `experiments.collect`, also of another computer), which is not collected
    dataset: str | None = None
    debug: bool = False  # show the traceback of every error
    given: tyro.conf.Suppress[frozenset[str]] = frozenset()  # names of the options on the command line


def command(presets: Mapping[str, Config], workdir: str, description: str | None) -> None:
    """Run an experiment from the command line, with the presets by name and the default of `--workdir`."""
    with on_one_line(debug="debug" in options(sys.argv[1:])):
        args = parse(presets, workdir, description)
        sts.enable_compilation_cache()
        main(configure(args), args.workdir, only=args.only, skin=args.skin, source=args.dataset)


def parse(presets: Mapping[str, Config], workdir: str, description: str | None) -> Args:
    """Read the options, which replace single fields of the preset that `--preset` names."""
    preset = chosen_preset(presets, sys.argv[1:])
    default = Args(Path(workdir), preset)
    args = tyro.cli(Args, default=default, description=description, config=(tyro.conf.AvoidSubcommands,))
    for field in WITHOUT_EFFECT[args.config.model]:
        value = getattr(args.config, field)
        if value != getattr(preset, field):
            option = f"--{field.replace('_', '-')}" + ".*" * dataclasses.is_dataclass(value)
            say(f"note: {option} has no effect, because --model {args.config.model} is trained")
    given = options(sys.argv[1:])
    return dataclasses.replace(args, config=with_epochs(args.config, given), given=given)


def options(words: Sequence[str]) -> frozenset[str]:
    """Names of the options on a command line, such as `collection.num-objects`."""
    return frozenset(word[2:].partition("=")[0].replace("_", "-") for word in words if word.startswith("--"))


def with_epochs(config: Preset, given: frozenset[str]) -> Preset:
    """Drop the preset's numbers of gradient steps if the command line has the number of epochs or other steps."""
    changes: dict[str, object] = {}
    if hasattr(config, "steps") and {"training.epochs", "training.steps"} & given and "steps" not in given:
        changes["steps"] = None
    for name in ("training", "state-training"):
        if f"{name}.epochs" in given and f"{name}.steps" not in given:
            field = name.replace("-", "_")
            changes[field] = dataclasses.replace(getattr(config, field), steps=None)
    return dataclasses.replace(config, **changes)  # type: ignore[type-var]


def chosen_preset(
    presets: Mapping[str, Preset], words: Sequence[str], option: str = "preset", default: str = "default"
) -> Preset:
    """The preset that `--preset` or another option selects. For an unknown name, which tyro reports, the default."""
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    first.add_argument(f"--{option}", dest="name", nargs="?")
    return presets.get(first.parse_known_args(list(words))[0].name, presets[default])


def configure(args: Args) -> Config:
    """Apply the options to the configuration, and list the objects of `--objects` in the work directory."""
    check(args.config)
    collection = args.config.collection
    scenario = sts.physics.variant(collection.scenario, args.hidden)
    collection = dataclasses.replace(collection, scenario=scenario, parts=args.parts or collection.parts)
    if args.objects is None and (args.scale is not None or args.up is not None):
        raise ValueError("--scale and --up apply only to mesh files in a folder: give the folder with --objects")
    if args.objects is not None:
        collection = with_meshes(collection, args.objects, args)
    elif args.classes:
        collection = dataclasses.replace(collection, categories=tuple(dict.fromkeys(args.classes)))
    config = dataclasses.replace(args.config, collection=collection)
    check(config)
    return config


def with_meshes(collection: dataset.Collection, folder: Path, args: Args) -> dataset.Collection:
    """Replace the objects of a collection by those of a folder, with about the same number of trajectories in total.

    Options for the number of trajectories and for the classes that are on the command line are left as they are.
    """

    def spread(name: str, number: int) -> int:
        given = f"collection.{name}" in args.given
        return number if given else max(number, round(collection.num_objects * number / count))

    classes = sts.objects.library(folder, scale=args.scale).classes
    asked = args.classes or (collection.categories if "collection.categories" in args.given else ())
    taken = asked or tuple(name for name in classes if name in collection.categories) or classes
    path = args.workdir / "objects.txt"
    with storage.lock(args.workdir, finished=True):  # so that another run in this folder does not lose its listing
        meshes, listing = dataset.survey_meshes(
            folder,
            collection.scenario,
            classes=taken,
            scale=args.scale,
            up=args.up,
            parts=collection.parts,
            cache=cache_folder() / "objects",
            progress=say,
        )
        others = ", ".join(name for name in classes if name not in taken)
        if others:
            listing += f"classes left out: {others}; --classes takes others\n"
        if not path.exists() or path.read_bytes() != listing.encode():
            storage.write_bytes(path, listing.encode())
    count = len(meshes.names)
    say(f"objects of the classes {', '.join(taken)}: {path} lists {count} that can be used and those left out")
    each, rendered = spread("num-per-object", collection.num_per_object), None
    if collection.num_rendered is not None:
        rendered = spread("num-rendered", collection.num_rendered)
        if "collection.num-rendered" not in args.given:
            rendered = min(rendered, each)
    collection = dataclasses.replace(
        collection,
        meshes=meshes,
        num_objects=collection.num_objects if "collection.num-objects" in args.given else count,
        num_per_object=each,
        num_rendered=rendered,
    )
    sizes = ", ".join(f"{name} {len(part)}" for name, part in dataset.split_objects(collection).items())
    say(f"{count} objects with {each} trajectories each, split into {sizes}")
    return collection


def sensor(skin: Skin) -> sts.Sensor:
    """The sensor of an experiment. A `clear` skin only transmits light."""
    default = sts.Sensor()
    if skin == "hazy":
        return default
    room = dataclasses.replace(default.room, haze=1e3, milk=0.0, tint=jnp.ones(3), crease=0.0, vignette=0.0)
    return dataclasses.replace(default, room=room)


def main(
    config: Config,
    workdir: Path,
    *,
    only: Stage | None = None,
    own: Extensions = NONE,
    skin: Skin = "hazy",
    source: str | None = None,
) -> None:
    """Collect the dataset, train the models, evaluate them, and print the main table.

    Args:
        config: Configuration of the experiment.
        workdir: Work directory for the results.
        only: Stage to run, with the results of the earlier stages in `workdir`. None: all stages.
        own: Your own loss, optimiser, logger, metrics and modalities.
        skin: Skin of the sensor that collects the dataset. The later stages use the sensor of the dataset.
        source: Folder or URL of a finished dataset, to which `dataset` in `workdir` becomes a link. None: the dataset
            is collected.
    """
    check(config, own)
    with storage.lock(workdir, finished=True):
        if source is not None:  # a dataset that does not fit must not claim the work directory
            collected = sensor(skin) if only in (None, "collect") else None  # later stages use that of the dataset
            data = finished(source, config.collection, collected)
        places = [f"collection.{name}" for name in dataset.PLACES]
        storage.claim(workdir / "config.json", dataclasses.asdict(config), storage.default_fields(config), places)
        folder = workdir / "dataset"
        if source is not None:
            link(data, source, folder)
        elif only in (None, "collect"):
            data = collect(config.collection, sensor(skin), folder)
        else:
            data = dataset.load(folder)
        if only == "collect":
            return
        for split in config.splits:
            run = Run(config, workdir, sts.Sensor.load(folder / "sensor.json"), split)
            if only in (None, "train"):
                train(run, data, own)
            if only in (None, "evaluate"):
                print(evaluate(run, data, own))


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
    """Prepare the trainings of an experiment. Only the state-space model uses `views` and `falls`."""
    scenario = config.collection.scenario
    frame = dataset.empty_frame(sensor, config.collection)
    empty = {"visual": frame.visual, "tactile": frame.tactile}
    if config.model == "statespace":
        model, preprocessing = training.state_model(
            pairs, sensor, scenario, config.preprocessing, empty, image_size=config.image_size
        )
        arrays = training.state_arrays(pairs, model, scenario, preprocessing, empty, views=views, falls=falls)
        del pairs  # frees memory, because `arrays` contains copies of the same size
        yield Job("statespace", config.state_training, model, arrays, preprocessing, empty)
        return
    pairs, empty = dataset.reduced(pairs, config.image_size), dataset.reduced_images(empty, config.image_size)
    for number, (name, modalities) in enumerate(MODELS["paper"].items()):
        further = measurements if number == 0 else ()
        arrays, preprocessing = training.frame_arrays(
            pairs, modalities, config.preprocessing, empty["tactile"], measurements=further
        )
        schedule = config.training
        if config.steps is not None:
            schedule = dataclasses.replace(schedule, steps=config.steps[number])
        networks = training.paper_model(
            modalities,
            preprocessing,
            measurements=further,
            encode_condition=config.encode_condition,
            prior=config.prior,
        )
        yield Job(name, schedule, networks, arrays, preprocessing, empty)


def apart(rows: Mapping[str, np.ndarray], split: str) -> dict[str, np.ndarray]:
    """The trajectories of each part of a split, of which those for validation are not trained on.

    A split by trajectory has no validation part of its own (`evaluation.rows_of`), so a part of the training is taken.
    """
    if split != "trajectory":
        return dict(rows)
    validation = rows["train"][::_VALIDATION]
    return {**rows, "train": np.setdiff1d(rows["train"], validation), "validation": validation}


def train(run: Run, data: dataset.Dataset, own: Extensions = NONE) -> None:
    """Train the models of one split, and show the progress. The state-space model is calibrated afterwards."""
    config, rows = run.config, evaluation.rows_of(data, run.split)
    state, falls = config.model == "statespace", None
    used = apart(rows, run.split) if state else rows
    train, validation = used["train"], used["validation"]
    if state:  # also those without images, but none that is held out
        falls = np.setdiff1d(data.members("train", rendered=False), np.union1d(rows["test"], validation))
    # The trajectories are passed without a variable of their own, so that `jobs` can free their memory.
    for job in jobs(
        config,
        run.sensor,
        data.pairs(train, measurements=own.measurements),
        data.views("train") if state else None,
        None if falls is None else data.ends(falls),
        own.measurements,
    ):
        folder = run.folder(job.name)
        training.claim_split(folder, rows)
        train_model(job, folder, config.targets, own)
        if isinstance(job.model, statespace.Config):
            pairs, scenario = data.pairs(validation), config.collection.scenario
            arrays = training.state_arrays(pairs, job.model, scenario, job.preprocessing, job.empty)
            training.calibrate(folder, arrays)


def train_model(
    job: Job,
    folder: Path,
    targets: Literal["all", "own"],
    own: Extensions = NONE,
    progress: Callable[[int, int, dict[str, float]], None] | None = None,
    validation: training.Arrays | None = None,
) -> None:
    """Train a model in a folder, or continue an interrupted training. Without `progress`, a bar is shown."""
    with Bar() as bar:

        def show(done: int, total: int, record: dict[str, float]) -> None:
            bar(f"train {job.name}", done, total, f"loss {record['loss']:.4g}" if record else "")

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
            progress=progress or show,
            log=None if own.log is None else own.log(job.name),
            validation=validation,
        )
