"""Will the lift hold? A gripper with a sensor on each finger predicts it from the moment of grasp.

    python -m experiments.gripper                   # about 20 minutes on two CPU cores, can be resumed
    python -m experiments.gripper --preset smoke    # a minute, for tests

The fingers close on a procedural object, lift it by 5 mm, and the networks see what the two sensors see at this moment.
Then the hand lifts the object higher and shakes it, and the object stays between the fingers or slides out. Mass,
friction and grip force are hidden. The objects of the test are new to the networks.

The results go to `runs/gripper/`: `table.md`, `metrics.json` and figures. See `docs/experiments.md` for the files and
the options. Every field of the configuration is an option too: `--lifts.num-objects 100`.
"""

import dataclasses
import functools
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import matplotlib.pyplot as plt
import numpy as np
import tyro

import sts_jax as sts
from experiments.shared import grasping, judging, run
from experiments.shared.evaluate import record, stale
from experiments.shared.grasping import Lifts
from experiments.shared.judging import HIDDEN, INPUTS, STREAMS, Training
from experiments.shared.terminal import Bar, on_one_line, say
from sts_jax import storage
from sts_jax._ranges import check as check_ranges
from sts_jax.evaluation import figures, metrics
from sts_jax.physics.scenario import G

*ALONE, BOTH = STREAMS
CONSTANT = "always the share of lifts that hold"
SHOWN = 4  # held and dropped lifts in the figure of grasps, each
TIMES = (1, grasping.CLOSED, grasping.MOMENT, grasping.LIFTED, grasping.END)  # time steps in the figure of lifts


@dataclasses.dataclass(frozen=True)
class Config:
    """The configuration: lifts, training, and seeds."""

    lifts: Lifts = dataclasses.field(default_factory=Lifts)  # the dataset
    training: Training = dataclasses.field(default_factory=Training)  # training of every network
    seeds: tuple[int, ...] = (0, 1, 2)  # of the networks


DEFAULT = Config()
SMOKE = Config(
    Lifts(num_objects=8, num_per_object=3, shares=(0.5, 0.25, 0.25), objects_per_shard=4, resolution=32),
    Training(steps=4, batch_size=8, validate_every=2),
    seeds=(0,),
)
PRESETS = {"smoke": SMOKE, "default": DEFAULT}


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of the command line."""

    workdir: Path  # folder for the results
    # configuration of the preset. Each of its fields is an option
    config: Annotated[Config, tyro.conf.arg(name="")]
    preset: Literal["smoke", "default"] = "default"  # set of default values for the options
    debug: bool = False  # show the traceback of every error


def check(config: Config) -> None:
    """Raise a ValueError for a mistake in the configuration, before anything is computed."""
    config.lifts.check()
    check_ranges(config.training)
    if not config.seeds or len(set(config.seeds)) < len(config.seeds) or min(config.seeds) < 0:
        raise ValueError(f"seeds must be one or more different whole numbers >= 0, got {config.seeds}")


def main(config: Config, workdir: Path) -> None:
    """Collect the lifts, train and test the networks, and write the table and the figures."""
    check(config)
    with storage.lock(workdir, finished=True):
        storage.claim(workdir / "config.json", dataclasses.asdict(config), storage.default_fields(config))
        with Bar() as bar:
            data = grasping.collect(config.lifts, workdir / "dataset", lambda done, total: bar("lift", done, total))
        parts = {name: np.flatnonzero(np.isin(data["object"], part)) for name, part in config.lifts.split().items()}
        say(f"{len(data['held'])} lifts, of which {data['held'].mean():.0%} hold")
        judged = {name: probabilities(config, workdir, data, parts, name) for name in INPUTS}
        write(config, workdir, data, parts, judged)
        print((workdir / "table.md").read_text(), end="")


def probabilities(
    config: Config, workdir: Path, data: Mapping[str, np.ndarray], parts: Mapping[str, np.ndarray], name: str
) -> np.ndarray:
    """Probabilities that the test lifts hold, (seeds, n), from one of INPUTS. What is missing is trained."""
    rows, inputs = [], {"dataset": storage.sha256(workdir / "dataset" / storage.MANIFEST)}
    for seed in config.seeds:
        file = workdir / "scores" / f"{name.replace(' ', '-')}-seed{seed}.npz"
        if stale(workdir, f"{name}, seed {seed}", inputs) is not None:
            with Bar() as bar:
                shown = functools.partial(bar, f"{name}, seed {seed}", total=config.training.steps)
                found = judging.judged(config.training, data, parts, name, seed, shown)
            storage.write_arrays(file, {"probability": found, "held": data["held"][parts["test"]]})
            record(workdir, f"{name}, seed {seed}", inputs, [file])
        rows.append(storage.read_arrays(file, f"delete {file}")["probability"])
    return np.stack(rows)


def write(
    config: Config,
    workdir: Path,
    data: Mapping[str, np.ndarray],
    parts: Mapping[str, np.ndarray],
    judged: Mapping[str, np.ndarray],
) -> None:
    """Write the table, the metrics and the figures, unless they are there already."""
    files = [f"scores/{name.replace(' ', '-')}-seed{seed}.npz" for name in INPUTS for seed in config.seeds]
    inputs = storage.checksums(workdir, files)
    if stale(workdir, "results", inputs) is None:
        return
    test, base = parts["test"], np.clip(data["held"][parts["train"]].mean(), 1e-4, 1 - 1e-4)
    rows = {CONSTANT: np.full((1, len(test)), base), **judged}
    scores = {name: score(row, data["held"][test]) for name, row in rows.items()}
    numbers = summarise(scores, data["object"][test])
    storage.write_json(workdir / "metrics.json", numbers)
    storage.write_bytes(workdir / "table.md", table(config, data, parts, numbers).encode())
    drawn = [workdir / "figures" / name for name in ("grasps.png", "lifts.png")]
    draw_grasps(drawn[0], data, test, judged)
    draw_lifts(drawn[1], config.lifts, data, test)
    record(workdir, "results", inputs, [workdir / "table.md", workdir / "metrics.json", *drawn])


def score(probability: np.ndarray, held: np.ndarray) -> dict[str, np.ndarray]:
    """Accuracy and log loss (nats) of each lift, means over the seeds."""
    truth = np.where(held, probability, 1 - probability)
    return {"accuracy": (truth > 0.5).mean(axis=0), "log loss": -np.log(truth).mean(axis=0)}


def summarise(scores: Mapping[str, Mapping[str, np.ndarray]], objects: np.ndarray) -> dict[str, dict[str, Any]]:
    """Means with 95 % intervals over objects, and paired differences from vision and from touch."""
    rows = {(name, metric): values for name, row in scores.items() for metric, values in row.items()}
    for one in ALONE:
        rows |= {(f"{BOTH} - {one}", metric): values - scores[one][metric] for metric, values in scores[BOTH].items()}
    values = np.stack(list(rows.values()))
    draws = metrics.bootstrap(objects, lambda weight: values @ weight / weight.sum())
    summary: dict[str, dict[str, Any]] = {}
    for place, (name, metric) in enumerate(rows):
        low, high = metrics.interval(draws[:, place])
        summary.setdefault(name, {})[metric] = {"value": float(values[place].mean()), "low": low, "high": high}
    return summary


def table(
    config: Config, data: Mapping[str, np.ndarray], parts: Mapping[str, np.ndarray], numbers: Mapping[str, Any]
) -> str:
    """The table in Markdown."""

    def cell(name: str, metric: str) -> str:
        number = numbers[name][metric]
        return metrics.written(number["value"], number["low"], number["high"], 3)

    lifts, test = config.lifts, parts["test"]
    lines = [
        "# Will the lift hold?",
        "",
        "| input at the moment of grasp | accuracy | log loss (nats) |",
        "|---|---|---|",
        *(f"| {name} | {cell(name, 'accuracy')} | {cell(name, 'log loss')} |" for name in (CONSTANT, *INPUTS)),
        "",
        *(
            f"- Both streams minus {one} alone: accuracy {cell(f'{BOTH} - {one}', 'accuracy')}, log loss "
            f"{cell(f'{BOTH} - {one}', 'log loss')}."
            for one in ALONE
        ),
        f"- {len(test)} lifts of {len(np.unique(data['object'][test]))} objects that are not in the training data "
        f"({len(parts['train'])} lifts). {data['held'][test].mean():.1%} of the test lifts hold.",
        f"- Means over {len(config.seeds)} networks for each input, with 95 % intervals over the objects.",
        f"- Hidden: density {lifts.density[0]:g} to {lifts.density[1]:g} kg/m^3, friction {lifts.friction[0]:g} to "
        f"{lifts.friction[1]:g}, grip force {lifts.grip[0]:g} to {lifts.grip[1]:g} N. `{HIDDEN}` knows all three.",
    ]
    return "\n".join(lines) + "\n"


def draw_grasps(path: Path, data: Mapping[str, np.ndarray], test: np.ndarray, judged: Mapping[str, np.ndarray]) -> None:
    """Draw both streams of both fingers at the moment of grasp, for some lifts that hold and some that do not."""
    held = data["held"][test]
    _, first = np.unique(data["object"][test], return_index=True)
    order = np.concatenate([first, np.setdiff1d(np.arange(len(test)), first)])  # of different objects, if possible
    chosen = np.concatenate([order[held[order]][:SHOWN], order[~held[order]][:SHOWN]])
    rows = [(stream, side) for stream in ("visual", "tactile") for side in range(2)]
    figure, axes = plt.subplots(len(rows), len(chosen), figsize=(1.5 * len(chosen) + 0.5, 7.4), squeeze=False)
    for column, item in enumerate(chosen):
        for row, (stream, side) in enumerate(rows):
            figures.pictures.show(axes[row, column], data[stream][test[item], side] / 255)
            if column == 0:
                axes[row, 0].set_ylabel(f"{stream}, {grasping.SIDES[side]}", fontsize=8)
        axes[0, column].set_title("holds" if held[item] else "drops", fontsize=9)
        said = [f"{name}: {judged[name][:, item].mean():.0%}" for name in STREAMS]
        axes[-1, column].set_xlabel("\n".join(said), fontsize=7)
    figure.suptitle("the moment of grasp, with the predicted probability that the lift holds", fontsize=10)
    figures.pictures.save(figure, path)


def draw_lifts(path: Path, lifts: Lifts, data: Mapping[str, np.ndarray], test: np.ndarray) -> None:
    """Draw a lift that holds and one that fails after the moment of grasp, from outside and with the left streams."""
    held, load = data["held"][test], -data["wrench"][test, :, 1].sum(axis=1)
    missing = np.abs(load / (G * data["mass"][test]) - 1)  # of the weight, 1 if the object is on the table
    items = [*test[held][:1], *test[~held][np.argsort(missing[~held])[:1]]]
    shape = 3 * len(items), len(TIMES)
    figure, axes = plt.subplots(*shape, figsize=(1.8 * shape[1] + 0.5, 1.8 * shape[0] + 0.5), squeeze=False)
    for block, item in zip(range(0, shape[0], 3), items, strict=True):
        number = int(data["object"][item])
        pictures = grasping.replay(lifts, number, int(item - np.argmax(data["object"] == number)), TIMES)
        for column, (step, shown) in enumerate(zip(TIMES, pictures, strict=True)):
            for row, (name, image) in enumerate(shown.items(), block):
                figures.pictures.show(axes[row, column], image)
                if column == 0:
                    axes[row, 0].set_ylabel(name, fontsize=8)
            axes[block, column].set_title(f"{step * grasping.DT:.1f} s", fontsize=8)
        axes[block, 0].set_title("holds" if data["held"][item] else "drops", fontsize=9)
    figures.pictures.save(figure, path)


if __name__ == "__main__":
    with on_one_line(debug="debug" in run.options(sys.argv[1:])):
        default = Args(Path("runs/gripper"), run.chosen_preset(PRESETS, sys.argv[1:]))
        args = tyro.cli(Args, default=default, description=__doc__, config=(tyro.conf.AvoidSubcommands,))
        sts.enable_compilation_cache()
        main(args.config, args.workdir)
