"""The command line of an experiment."""

import argparse
import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

import sts_jax as sts
from experiments.shared import errors, stages
from experiments.shared.config import Config, check
from experiments.shared.duration import plan
from experiments.shared.progress import say
from sts_jax import _files, dataset
from sts_jax.compilation import cache_folder

LEAST_OBJECTS = 10  # smallest number of objects in a folder, so that some can be held out for validation and test


def _folder(words: list[str]) -> Path:
    if not words[0].strip():
        raise ValueError("the name of the folder is empty: give a path, or '.' for the current directory")
    return Path(words[0])


# An empty name, often from an unset shell variable, would be the current directory.
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

    workdir: Folder  # for results
    # the configuration of the preset, every field of which can be changed
    config: Annotated[Config, tyro.conf.arg(name="")]
    preset: Literal["smoke", "default", "long", "paper"] = "default"  # the configuration that other options change
    only: stages.Stage | None = None  # run this stage only
    plan: bool = False  # print the expected seconds of each stage, from a short measurement, and stop
    hidden: sts.physics.Variant = "default"  # other hidden values, see physics.variant
    objects: Folder | None = None  # a folder of meshes, or of ShapeNetSem, instead of procedural objects
    # objects of these classes only, of the eight or of the folder (default: the experiment's classes, or all classes of
    # a folder that has none of them)
    classes: tuple[str, ...] = ()
    scale: float | None = None  # m, length of one unit of the folder's files: 0.001 for millimetres
    up: Literal["x", "y", "z"] | None = None  # the axis of the folder's files that points up
    parts: bool = False  # convex parts for objects whose hull fits badly
    debug: bool = False  # show the traceback of every error


def run(presets: Mapping[str, Config], workdir: str, description: str | None) -> None:
    """Run an experiment from the command line."""
    args = parse(presets, workdir, description)
    with errors.on_one_line(debug=args.debug):
        sts.enable_compilation_cache()
        config = configure(args)
        if args.plan:
            print(plan(config))
        else:
            stages.main(config, args.workdir, only=args.only)


def parse(presets: Mapping[str, Config], workdir: str, description: str | None) -> Args:
    """Read the options. A field of the configuration that is not given keeps the value of the preset."""
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    first.add_argument("--preset", nargs="?")
    name = first.parse_known_args()[0].preset
    preset = presets.get(name, presets["default"])  # tyro reports an unknown name
    default = Args(Path(workdir), preset)
    with _concrete():
        args = tyro.cli(Args, default=default, description=description, config=(tyro.conf.AvoidSubcommands,))
    for model, field in (("paper", "training"), ("statespace", "state_training")):
        if args.config.model != model and getattr(args.config, field) != getattr(preset, field):
            option = f"--{field.replace('_', '-')}"
            say(f"note: {option}.* has no effect, because --model {args.config.model} is trained")
    return args


def _concrete() -> tyro.constructors.ConstructorRegistry:
    """A rule of tyro: a field whose type is a Protocol has the options of the dataclass that is its default."""
    registry = tyro.constructors.ConstructorRegistry()

    @registry.struct_rule
    def rule(info: tyro.constructors.StructTypeInfo) -> Any:
        kind = type(info.default)
        if not (getattr(info.type, "_is_protocol", False) and dataclasses.is_dataclass(kind)):
            return None
        concrete = tyro.constructors.StructTypeInfo.make(kind, info.default, in_union_context=False)
        return tyro.constructors.ConstructorRegistry.get_struct_spec(concrete)

    return registry


def configure(args: Args) -> Config:
    """Apply the options to the configuration. The objects of a folder are read, and listed in the work directory.

    Raises:
        FileNotFoundError: The folder of objects does not exist.
        ValueError: A class is unknown, a field of the configuration is out of range, two options contradict each other,
            or the folder has too few usable objects.
    """
    check(args.config)
    collection = args.config.collection
    scenario = sts.physics.variant(collection.scenario, args.hidden)
    collection = dataclasses.replace(collection, scenario=scenario, parts=args.parts or collection.parts)
    if args.objects is None and (args.scale is not None or args.up is not None):
        raise ValueError("--scale and --up are for the files of a folder: give it with --objects")
    if args.objects is not None:
        collection = with_meshes(collection, args.objects, args.workdir, args.classes, scale=args.scale, up=args.up)
    elif args.classes:
        collection = dataclasses.replace(collection, categories=tuple(dict.fromkeys(args.classes)))
    if collection.meshes is None:
        for category in collection.categories:
            sts.objects.find_family(category)
    return dataclasses.replace(args.config, collection=collection)


def with_meshes(
    collection: dataset.Collection,
    folder: Path,
    workdir: Path,
    classes: tuple[str, ...] = (),
    *,
    scale: float | None = None,
    up: Literal["x", "y", "z"] | None = None,
) -> dataset.Collection:
    """A collection of the objects of a folder, with about as many trajectories. Lists the objects in `objects.txt`.

    Args:
        collection: The collection of procedural objects.
        folder: See `objects.library`.
        workdir: Folder for the listing.
        classes: The classes to use. Empty means the classes of the collection that the folder has, or all classes of
            the folder if it has none of them.
        scale: See `objects.library`.
        up: See `objects.library`.
    """
    there = dataset.mesh_classes(folder)
    taken = classes or tuple(name for name in there if name in collection.categories) or there
    others = [name for name in there if name not in taken]
    path = workdir / "objects.txt"
    with _files.lock(workdir):  # another run in the folder keeps its listing
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
        # Collecting appends the objects that it left out to the listing.
        if not (path.exists() and path.read_text(errors="replace").startswith(listing)):
            _files.write_bytes(path, listing.encode())
    say(f"classes taken: {', '.join(taken)}" + (f"; left out: {', '.join(others)}" if others else ""))
    say(f"{len(meshes.names)} objects can be used. {path} lists them and the objects left out")
    if len(meshes.names) < LEAST_OBJECTS:
        raise ValueError(
            f"{folder}: a split needs at least {LEAST_OBJECTS} usable objects, got {len(meshes.names)}: add objects"
        )
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
