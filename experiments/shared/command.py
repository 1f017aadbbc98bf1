"""The command line of the experiments: its options, and the configuration that they describe."""

import argparse
import dataclasses
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Literal, TypeVar

import tyro

import sts_jax as sts
from experiments.shared import errors, stages
from experiments.shared.config import Config, check
from experiments.shared.duration import plan
from experiments.shared.progress import say
from sts_jax import dataset, storage
from sts_jax.compilation import cache_folder

Preset = TypeVar("Preset")  # type of a configuration


def _folder(words: list[str]) -> Path:
    """Convert the argument of an option to a path."""
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
    only: stages.Stage | None = None  # run only this stage of the experiment
    plan: bool = False  # measure each stage for a short time, print its expected duration, and stop
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


def run(presets: Mapping[str, Config], workdir: str, description: str | None) -> None:
    """Run an experiment from the command line.

    Args:
        presets: Configurations by name. The name `default` must be among them.
        workdir: Default of `--workdir`.
        description: Text for `--help`.
    """
    args = parse(presets, workdir, description)
    with errors.on_one_line(debug=args.debug):
        sts.enable_compilation_cache()
        config = configure(args)
        if args.plan:
            print(plan(config))
        else:
            stages.main(config, args.workdir, only=args.only)


def parse(presets: Mapping[str, Config], workdir: str, description: str | None) -> Args:
    """Read the options of the command line.

    The option `--preset` selects one of the presets. Without it, the preset is `default`. Other options can replace
    single fields of this preset.

    Args:
        presets: Configurations by name. The name `default` must be among them.
        workdir: Default of `--workdir`.
        description: Text for `--help`.
    """
    preset = chosen_preset(presets, sys.argv[1:])
    default = Args(Path(workdir), preset)
    args = tyro.cli(Args, default=default, description=description, config=(tyro.conf.AvoidSubcommands,))
    for model, field in (("paper", "training"), ("statespace", "state_training")):
        if args.config.model != model and getattr(args.config, field) != getattr(preset, field):
            option = f"--{field.replace('_', '-')}"
            say(f"note: {option}.* has no effect, because --model {args.config.model} is trained")
    return args


def chosen_preset(presets: Mapping[str, Preset], words: Sequence[str]) -> Preset:
    """Return the preset that `--preset` selects. If the name is missing or unknown, return the preset `default`.

    Args:
        presets: Presets by name. The name `default` must be among them.
        words: Words of the command line.
    """
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    first.add_argument("--preset", nargs="?")
    name = first.parse_known_args(list(words))[0].preset
    return presets.get(name, presets["default"])  # tyro reports an unknown name


def configure(args: Args) -> Config:
    """Apply the options to the configuration of the preset.

    With `--objects`, the objects of the folder are read and listed in `objects.txt` in the work directory.

    Raises:
        FileNotFoundError: The folder of objects does not exist.
        ValueError: A class is unknown, a field of the configuration is out of range, two options contradict each other,
            or the folder has too few usable objects.
        LockedError: Another process works in the work directory.
    """
    check(args.config)
    collection = args.config.collection
    scenario = sts.physics.variant(collection.scenario, args.hidden)
    collection = dataclasses.replace(collection, scenario=scenario, parts=args.parts or collection.parts)
    if args.objects is None and (args.scale is not None or args.up is not None):
        raise ValueError("--scale and --up apply only to mesh files in a folder: give the folder with --objects")
    if args.objects is not None:
        collection = with_meshes(collection, args.objects, args.workdir, args.classes, scale=args.scale, up=args.up)
    elif args.classes:
        collection = dataclasses.replace(collection, categories=tuple(dict.fromkeys(args.classes)))
    config = dataclasses.replace(args.config, collection=collection)
    check(config)
    return config


def with_meshes(
    collection: dataset.Collection,
    folder: Path,
    workdir: Path,
    classes: tuple[str, ...] = (),
    *,
    scale: float | None = None,
    up: Literal["x", "y", "z"] | None = None,
) -> dataset.Collection:
    """Replace the objects of a collection by the objects of a folder.

    If the folder has fewer objects than the collection, each object gets more trajectories, so that the total number of
    trajectories stays about the same. Otherwise the number of trajectories per object does not change.

    The objects are listed in `objects.txt` in the work directory.

    Args:
        collection: Collection of procedural objects.
        folder: Folder of mesh files, or of ShapeNetSem.
        workdir: Work directory for the listing.
        classes: Classes to use. If empty, the classes that occur in both the collection and the folder are used. If no
            class occurs in both, all classes of the folder are used.
        scale: Length of one unit of the files (m). Default: as in `objects.library`.
        up: Axis of the files that points up. Default: as in `objects.library`.

    Raises:
        FileNotFoundError: The folder does not exist.
        ValueError: A class is unknown, or the folder has no usable object.
        LockedError: Another process works in the work directory.
    """
    there = dataset.mesh_classes(folder)
    taken = classes or tuple(name for name in there if name in collection.categories) or there
    others = [name for name in there if name not in taken]
    path = workdir / "objects.txt"
    with storage.lock(workdir):  # so that another run in this folder does not lose its listing
        meshes, listing = dataset.survey_meshes(
            folder,
            collection.scenario,
            classes=taken,
            scale=scale,
            up=up,
            parts=collection.parts,
            cache=cache_folder() / "objects",
            progress=say,
        )
        if others:
            listing += f"classes left out: {', '.join(others)}; --classes takes others\n"
        # The stage `collect` appends the objects that it left out, so the file may be longer than this listing.
        if not (path.exists() and path.read_text(errors="replace").startswith(listing)):
            storage.write_bytes(path, listing.encode())
    say(f"classes used: {', '.join(taken)}" + (f". Left out: {', '.join(others)}" if others else ""))
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
