"""Skill of the state-space model for different numbers of training trajectories and of training steps.

    python -m benchmarks.scaling runs/freefall --out scaling.png                     # about 20 minutes
    python -m benchmarks.scaling runs/freefall --shares 1 --steps 1900 --seeds 1 2   # two more seeds show the spread

The command trains models on the dataset of a run (with `--preset default`), in the folder `scaling` of the run: some on
a share of the training objects (`--shares`) with the largest number of `--steps`, the others on all training objects
with each number of `--steps`. It prints the errors for the held-out objects, and plots the visual skill to `--out`.
"""

import collections
import dataclasses
import itertools
import time
from pathlib import Path
from typing import Annotated, Literal, NamedTuple, TypeVar

import jax
import matplotlib.pyplot as plt
import numpy as np
import tyro

import sts_jax as sts
from benchmarks.instruments.experiments import EXPERIMENTS
from experiments.shared import run
from experiments.shared.config import Config
from experiments.shared.terminal import say
from sts_jax import dataset, evaluation, storage

Part = TypeVar("Part", dataset.Pairs, dataset.Views, dataset.Ends)
SUBSETS = (("visual", "pose"), ("visual",))


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of the command line."""

    workdir: Annotated[Path, tyro.conf.Positional]  # work directory of an experiment
    scenario: Literal["freefall", "inclined", "perturbed"] = "freefall"  # scenario of the work directory
    preset: Literal["smoke", "default", "long"] = "default"  # preset of the work directory
    # shares of the training objects. A model of each share is trained for the largest number of `steps`
    shares: tuple[float, ...] = (1 / 16, 1 / 4, 1.0)
    steps: tuple[int, ...] = (400, 800, 1600)  # gradient steps. A model of each number sees all training objects
    seeds: tuple[int, ...] = (0,)  # seeds of the weights and of the order of the batches
    out: Path = Path("scaling.png")  # file of the plot, which shows the first seed


def some(part: Part, objects: np.ndarray) -> Part:
    """Select the items of `part`, such as trajectories or views, whose object number is in `objects`."""
    rows = np.isin(part.object, objects)
    chosen: Part = jax.tree.map(lambda leaf: leaf[rows], part)
    return chosen


def train(
    config: Config, data: dataset.Dataset, folder: Path, share: float, steps: int, seed: int
) -> tuple[int, float]:
    """Train a model, unless `folder` already contains a trained model."""
    pairs, views = data.pairs(data.members("train")), data.views("train")
    falls = data.ends(data.members("train", rendered=False))
    objects = np.unique(falls.object)
    kept = objects[: max(round(share * len(objects)), 1)]
    pairs, views, falls = some(pairs, kept), some(views, kept), some(falls, kept)
    job = next(run.jobs(config, sts.Sensor(), pairs, views, falls))
    warmup = min(job.schedule.warmup, steps // 4)
    schedule = dataclasses.replace(job.schedule, steps=steps, warmup=warmup, seed=seed)
    note, stamps = folder / "seconds.json", []
    if not note.exists():
        run.train_model(
            job._replace(schedule=schedule),
            folder,
            config.targets,
            progress=lambda *_: stamps.append(time.monotonic()),
        )
        storage.write_json(note, float(np.median(np.diff(stamps))) * steps)
    return len(falls.object), storage.read_json(note, f"delete {folder}") / 60


class Trained(NamedTuple):
    """A trained model."""

    name: str  # its inputs
    trajectories: int  # number of training trajectories
    steps: int  # number of gradient steps
    minutes: float  # training time


def plot(path: Path, models: dict[Trained, dict[str, float]], best: float | None, title: str) -> None:
    """Draw the visual skill, with its interval, over the number of trajectories and over the training time."""
    figure, axes = plt.subplots(1, 2, figsize=(10.5, 4.8), sharey=True, layout="constrained")
    for axis, along, fixed in ((axes[0], "trajectories", "steps"), (axes[1], "minutes", "trajectories")):
        lines = collections.defaultdict(list)
        for model in sorted(models, key=lambda model: getattr(model, along)):
            lines[model.name, getattr(model, fixed)].append(model)
        trends = {name for (name, _), line in lines.items() if len(line) > 1}
        for (name, number), line in lines.items():
            if len(line) > 1 or name not in trends:
                skill, low, high = (np.array([models[one][key] for one in line]) for key in ("value", "low", "high"))
                place = [getattr(one, along) for one in line]
                label = f"{name}, {number:,} {fixed}"
                axis.errorbar(place, skill, [skill - low, high - skill], fmt="o-", capsize=3, label=label)
        if best is not None:
            axis.axhline(best, color="gray", linestyle="--", label="ceiling (re-rolls)")
        axis.set_xscale("log")
        axis.set_xlabel(f"training {along}")
        axis.grid(alpha=0.3)
        axis.legend(fontsize=9)
    axes[0].set_ylabel("visual skill, held-out objects")
    figure.suptitle(title, fontsize=11)
    figure.savefig(path, dpi=130)


def main(args: Args) -> str:
    """Train and score every model, and return a table with a row for each model and subset of inputs."""
    sts.enable_compilation_cache()
    config = EXPERIMENTS[args.scenario].PRESETS[args.preset]
    with storage.lock(args.workdir):
        storage.claim(args.workdir / "config.json", dataclasses.asdict(config))
        data = run.collect(config.collection, sts.Sensor(), args.workdir / "dataset")
        sizes = dict.fromkeys([(share, max(args.steps)) for share in args.shares] + [(1.0, n) for n in args.steps])
        given = data.pairs(data.members("test"))
        test, scenario = dataset.reduced(given, config.image_size), config.collection.scenario
        train_pairs = dataset.reduced(data.pairs(data.members("train")), config.image_size)
        judge = evaluation.scorer(scenario, train_pairs)
        scores = {name: judge(row, test) for name, row in evaluation.baselines(scenario, train_pairs, test).items()}
        points = {}
        for (share, steps), seed in itertools.product(sizes, args.seeds):
            folder = args.workdir / "scaling" / f"{share:.4f}-{steps}-{seed}"
            trajectories, minutes = train(config, data, folder, share, steps, seed)
            predictor = sts.Predictor.load(folder)
            for subset in SUBSETS:
                title = f"{' and '.join(subset)}: {trajectories} trajectories, {steps} steps, seed {seed}"
                say(title)
                found = evaluation.predict(predictor, subset, given, scenario, num_samples=config.num_samples)
                scores[title] = judge(found, test)
                points[title] = Trained(" and ".join(subset), trajectories, steps, round(minutes, 1))
    summary = evaluation.summarise(scores, test, outcomes=scenario.outcomes)
    skills = {title: summary["predictors"][title]["visual_skill"] for title in points}
    shown = {points[title]: skill for title, skill in skills.items() if title.endswith(f"seed {args.seeds[0]}")}
    title, metrics = f"{args.workdir.name}: visual skill of the state-space model", args.workdir / "metrics.json"
    best = None
    if metrics.exists():
        best = storage.read_json(metrics, "evaluate again")["predictors"][evaluation.CEILING]["visual_skill"]["value"]
    plot(args.out, shown, best, title)
    notes = [f"{title}: {model.minutes} minutes of training" for title, model in points.items()]
    return evaluation.table(summary, title=f"{args.workdir.name}: scaling", rows=list(points), notes=notes)


if __name__ == "__main__":
    print(main(tyro.cli(Args, description=__doc__)))
