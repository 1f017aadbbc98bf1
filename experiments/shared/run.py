"""An experiment from its command line to its results: collect, train, evaluate. Each stage can be resumed."""

import argparse
import dataclasses
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Literal, NamedTuple, TypeVar

import numpy as np
import tyro

import sts_jax as sts
from experiments.shared.config import MODELS, NONE, Config, Extensions, Run, check
from experiments.shared.evaluate import evaluate
from experiments.shared.terminal import Bar, on_one_line, say
from sts_jax import dataset, evaluation, mvae, statespace, storage, training
from sts_jax.compilation import cache_folder
from sts_jax.training import TrainConfig

Stage = Literal["collect", "train", "evaluate"]
Preset = TypeVar("Preset")  # type of a configuration


def _folder(words: list[str]) -> Path:
    if not words[0].strip():
        raise ValueError("the name of the folder is empty: give a path, or '.' for the current directory")
    return Path(words[0])


# An option that is the path of a folder. An empty path is refused, because it would be the current directory. It often
# comes from an unset variable of the shell.
Folder = Annotated[
    Path,
    tyro.constructors.PrimitiveConstructorSpec(
        nargs=1,
        metavar="PATH",
        instance_from_str=_folder,
        is_instance=lambda value: isinstance(value, Path),
        str_from_instance=lambda path: [str(path)],
    ),
]


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of the command line of an experiment."""

    workdir: Folder  # folder for the results
    # configuration of the preset. Each of its fields is an option
    config: Annotated[Config, tyro.conf.arg(name="")]
    preset: Literal["smoke", "default", "long", "paper"] = "default"  # set of default values for the options
    only: Stage | None = None  # run only this stage of the experiment
    # ranges of the hidden properties fill, shell mass and friction: those of the scenario (default), only the middle of
    # each range (off), a wider range of friction (wide-friction), or contents that may lie on any side of the
    # object (off-centre)
    hidden: sts.physics.Variant = "default"
    objects: Folder | None = None  # folder of mesh files or of ShapeNetSem, whose objects replace the procedural ones
    # classes of the objects. Empty: those of the experiment, or all classes of --objects if it has none of these
    classes: tuple[str, ...] = ()
    # length of one unit of the files in --objects (m), such as 0.001 for millimetres. None: that of ShapeNetSem's
    # table, or 1 m
    scale: float | None = None
    # axis of the files in --objects that points up. None: that of ShapeNetSem's table, or y for glTF and z for other
    # files
    up: Literal["x", "y", "z"] | None = None
    parts: bool = False  # decompose an object into convex parts if its convex hull fits badly
    debug: bool = False  # show the traceback of every error


def command(presets: Mapping[str, Config], workdir: str, description: str | None) -> None:
    """Run an experiment from the command line, with the presets by name and the default of `--workdir`."""
    args = parse(presets, workdir, description)
    with on_one_line(debug=args.debug):
        sts.enable_compilation_cache()
        main(configure(args), args.workdir, only=args.only)


def parse(presets: Mapping[str, Config], workdir: str, description: str | None) -> Args:
    """Read the options, which replace single fields of the preset that `--preset` names."""
    preset = chosen_preset(presets, sys.argv[1:])
    default = Args(Path(workdir), preset)
    args = tyro.cli(Args, default=default, description=description, config=(tyro.conf.AvoidSubcommands,))
    for model, field in (("paper", "training"), ("statespace", "state_training")):
        if args.config.model != model and getattr(args.config, field) != getattr(preset, field):
            option = f"--{field.replace('_', '-')}"
            say(f"note: {option}.* has no effect, because --model {args.config.model} is trained")
    return args


def chosen_preset(presets: Mapping[str, Preset], words: Sequence[str]) -> Preset:
    """The preset that `--preset` selects. For an unknown name, which tyro reports later, it is `default`."""
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    first.add_argument("--preset", nargs="?")
    return presets.get(first.parse_known_args(list(words))[0].preset, presets["default"])


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
    """Replace the objects of a collection by those of a folder, with about the same number of trajectories in total."""
    classes = sts.objects.library(folder).classes
    taken = args.classes or tuple(name for name in classes if name in collection.categories) or classes
    others = ", ".join(name for name in classes if name not in taken)
    path = args.workdir / "objects.txt"
    with storage.lock(args.workdir):  # so that another run in this folder does not lose its listing
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
        if others:
            listing += f"classes left out: {others}; --classes takes others\n"
        # The stage `collect` appends the objects that it left out, so the file may be longer than this listing.
        if not (path.exists() and path.read_text(errors="replace").startswith(listing)):
            storage.write_bytes(path, listing.encode())
    say(f"classes used: {', '.join(taken)}" + (f". Left out: {others}" if others else ""))
    say(f"{len(meshes.names)} objects can be used. {path} lists these and the objects left out")
    each, rendered = (
        max(count, round(collection.num_objects * count / len(meshes.names)))
        for count in (collection.num_per_object, collection.rendered_per_object)
    )
    return dataclasses.replace(
        collection,
        meshes=meshes,
        num_objects=len(meshes.names),
        num_per_object=each,
        num_rendered=None if collection.num_rendered is None else rendered,
    )


def main(config: Config, workdir: Path, *, only: Stage | None = None, own: Extensions = NONE) -> None:
    """Collect the dataset, train the models, evaluate them, and print the main table.

    Args:
        config: Configuration of the experiment.
        workdir: Work directory for the results.
        only: Stage to run, with the results of the earlier stages in `workdir`. None: all stages.
        own: Your own loss, optimiser, logger, metrics and modalities.
    """
    check(config, own)
    sensor = sts.Sensor()
    with storage.lock(workdir):
        data = collect(config, workdir, sensor) if only in (None, "collect") else _collected(config, workdir)
        if only == "collect":
            return
        for split in config.splits:
            run = Run(config, workdir, sensor, split)
            if only in (None, "train"):
                train(run, data, own)
            if only in (None, "evaluate"):
                _check_trained(run)
                print(evaluate(run, data, own))


def claim(config: Config, workdir: Path) -> None:
    """Write `config.json`, or check that the work directory has this configuration."""
    storage.claim(workdir / "config.json", dataclasses.asdict(config))


def collect(config: Config, workdir: Path, sensor: sts.Sensor) -> dataset.Dataset:
    """Simulate and render what is missing of the dataset, and open it. `objects.txt` lists objects left out."""
    claim(config, workdir)
    with Bar() as bar:
        collected = dataset.collect(
            config.collection,
            sensor,
            workdir / "dataset",
            progress=lambda p: bar(f"collect: {p.stage}", p.done, p.total),
        )
    left_out = [f"collect: left out {line}" for line in collected.left_out]
    for line in left_out:
        say(line)
    append(workdir / "objects.txt", left_out)
    if collected.resampled:
        say(
            f"collect: {collected.resampled} trajectories had non-finite values or sank into the pad and were drawn "
            "again"
        )
    return dataset.load(workdir / "dataset")


def append(path: Path, lines: Sequence[str]) -> None:
    """Append lines to a text file, except lines that the file contains already."""
    before = path.read_text(errors="replace") if path.exists() else ""
    new = "".join(f"{line}\n" for line in lines if f"{line}\n" not in before)
    if new:
        storage.write_bytes(path, (before + new).encode())


def _collected(config: Config, workdir: Path) -> dataset.Dataset:
    """Open the dataset of an earlier run."""
    claim(config, workdir)
    if not (workdir / "dataset" / "collection.json").exists():
        raise FileNotFoundError(
            f"{workdir / 'dataset'} is not a collected dataset: first run the command with `--only collect`"
        )
    return dataset.load(workdir / "dataset")


def _check_trained(run: Run) -> None:
    for name in MODELS[run.config.model]:
        if not (run.folder(name) / "config.json").exists():
            raise FileNotFoundError(
                f"{run.folder(name)} is not a trained model: first run the command with `--only train`"
            )


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
        yield Job(
            name,
            schedule,
            training.paper_model(modalities, preprocessing, measurements=further),
            arrays,
            preprocessing,
            empty,
        )


def train(run: Run, data: dataset.Dataset, own: Extensions = NONE) -> None:
    """Train the models of one split, and show the progress. The state-space model is calibrated afterwards."""
    config, rows = run.config, evaluation.rows_of(data, run.split)
    state = config.model == "statespace"
    # The trajectories are passed without a variable of their own, so that `jobs` can free their memory.
    for job in jobs(
        config,
        run.sensor,
        data.pairs(rows["train"], measurements=own.measurements),
        data.views("train") if state else None,
        data.ends(data.members("train", rendered=False)) if state else None,
        own.measurements,
    ):
        folder = run.folder(job.name)
        train_model(job, folder, config.targets, own)
        if isinstance(job.model, statespace.Config):
            validation, scenario = data.pairs(rows["validation"]), config.collection.scenario
            training.calibrate(
                folder, training.state_arrays(validation, job.model, scenario, job.preprocessing, job.empty)
            )


def train_model(
    job: Job,
    folder: Path,
    targets: Literal["all", "own"],
    own: Extensions = NONE,
    progress: Callable[[int, int, dict[str, float]], None] | None = None,
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
            progress=show if progress is None else progress,
            log=None if own.log is None else own.log(job.name),
        )
