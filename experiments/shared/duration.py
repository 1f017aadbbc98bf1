"""Estimates the duration of an experiment from a short measurement of each stage."""

import dataclasses
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

import sts_jax as sts
from experiments.shared import stages
from experiments.shared.config import Config, check, model_folder
from experiments.shared.judging import evaluate
from experiments.shared.progress import Bar
from sts_jax import dataset, evaluation

MANY = 8  # number of objects in the measurement


class Line(NamedTuple):
    """The expected duration of one part of an experiment."""

    part: str  # name of the part
    seconds: float  # expected duration (s)
    note: str  # remark in brackets, such as the measured rate


class Rate(NamedTuple):
    """The measured durations of one item (trajectory, frame or gradient step) and of the compilation."""

    each: float  # duration of one item (s)
    compiling: float  # duration of the compilation, which happens once (s)

    def of(self, total: int) -> float:
        """The expected duration of `total` items, including the compilation (s)."""
        return max(self.compiling, 0) + total * self.each


def plan(config: Config, *, num: int = 64, steps: int = 4) -> str:
    """Run a small part of each stage, and estimate the duration of the whole experiment.

    The simulation and the rendering run twice. Only the first run includes the compilation, so the difference between
    the two durations is the duration of the compilation.

    Args:
        config: Configuration of the experiment.
        num: Number of simulated trajectories, a multiple of 8. The first and the last frame of each trajectory are
            rendered once for each symmetry (rotation or reflection) of the scenario.
        steps: Number of gradient steps of each model.

    Returns:
        A text with one line for each part of the experiment, and a line for their sum.

    Raises:
        ValueError: A field of the configuration is out of range.
    """
    check(config)
    sensor = sts.Sensor()
    with tempfile.TemporaryDirectory() as name, Bar() as bar:
        folder = Path(name)
        trajectories, frames = _rates(config.collection, sensor, folder, num, bar)
        once = _collecting(config, trajectories, frames)
        data = dataset.load(folder / "0")
        each = [_ceilings(config, trajectories, frames), *_training(config, sensor, data, folder, steps, bar)]
        each.append(_evaluating(config, sensor, data, folder))
    repeats = len(config.splits)
    lines = [*once, *(line._replace(seconds=repeats * line.seconds) for line in each)]
    lines.append(Line("together", sum(line.seconds for line in lines), f"for {', '.join(config.splits)} split"))
    return shown(lines)


def shown(lines: Sequence[Line]) -> str:
    """Format the expected durations of the parts of an experiment as text, with one line for each part."""
    return "\n".join(f"{line.part:<36}{line.seconds:>9.0f} s   ({line.note})" for line in lines)


def _rates(collection: dataset.Collection, sensor: sts.Sensor, folder: Path, num: int, bar: Bar) -> tuple[Rate, Rate]:
    """Measure the rates of trajectories and of frames. Two datasets of `num` trajectories are collected.

    The second one shows the duration without compilation.

    Args:
        collection: Collection of the experiment.
        sensor: Sensor of the collection.
        folder: Folder for the datasets, which are named `0` and `1`.
        num: Number of trajectories of each dataset.
        bar: Progress bar.
    """
    spent: dict[str, list[float]] = {"trajectories": [], "frames": []}
    for seed in (0, 1):
        little = dataclasses.replace(
            dataset.head(collection, MANY),
            num_per_object=num // MANY,
            num_rendered=None,
            num_views=0,
            num_full=0,
            symmetries=True,
            seed=seed,
        )
        stamps = {"start": time.perf_counter()}

        def watch(progress: dataset.Progress, stamps: dict[str, float] = stamps) -> None:
            stamps[progress.stage] = time.perf_counter()
            bar(f"plan: {progress.stage}", progress.done, progress.total)

        dataset.collect(little, sensor, folder / str(seed), progress=watch)
        spent["trajectories"].append(stamps["trajectories"] - stamps["start"])
        spent["frames"].append(stamps["frames"] - stamps["trajectories"])
    measured = {"trajectories": num, "frames": 2 * len(collection.scenario.symmetries) * num}
    trajectories, frames = (Rate(again / measured[stage], once - again) for stage, (once, again) in spent.items())
    return trajectories, frames


def _collecting(config: Config, trajectories: Rate, frames: Rate) -> list[Line]:
    """The expected duration of the simulation and the rendering of the whole dataset."""
    collection = config.collection
    rendered = collection.num_objects * collection.rendered_per_object
    total = rendered * 2 * len(dataset.symmetries_of(collection))
    total += min(collection.num_full, rendered) * (collection.scenario.frames - 2)
    total += collection.num_objects * collection.num_views
    return [
        Line(
            f"collect: {count} {stage}",
            rate.of(count),
            f"{1 / rate.each:.3g} a second, {rate.compiling:.0f} s to compile",
        )
        for stage, count, rate in (
            ("trajectories", collection.num_trajectories, trajectories),
            ("frames", total, frames),
        )
    ]


def _ceilings(config: Config, trajectories: Rate, frames: Rate) -> Line:
    """The expected duration of the re-rolls for the ceiling."""
    collection = config.collection
    held_out = round(collection.shares[2] * collection.num_objects * collection.rendered_per_object)
    total = min(config.num_rerolled, held_out) * config.rerolls
    seconds = total * (trajectories.each + frames.each)
    return Line(f"ceilings: {total} trajectories", seconds, "simulated and drawn at the same rates")


def _training(
    config: Config, sensor: sts.Sensor, data: dataset.Dataset, folder: Path, steps: int, bar: Bar
) -> list[Line]:
    """Measure the training of each model for a few steps, in the folder of the small experiment."""
    collection, lines = config.collection, []
    rendered = collection.num_objects * collection.rendered_per_object
    share = evaluation.train_share(collection.shares, config.splits[0])
    samples = round(share * rendered) * len(dataset.symmetries_of(collection))
    pairs = data.pairs(data.rendered(), symmetries=True)
    for job in stages.jobs(config, sensor, pairs):
        stamps = [time.perf_counter()]

        def tick(done: int, total: int, _: dict, stamps: list[float] = stamps, name: str = job.name) -> None:
            stamps.append(time.perf_counter())
            bar(f"plan: train {name}", done, total)

        few = dataclasses.replace(job.schedule, steps=steps, warmup=0, log_every=1, checkpoint_every=steps)
        model = model_folder(folder, job.name, _small(config), "trajectory")
        stages.run(job._replace(schedule=few), model, config.targets, tick)
        each = float(np.median(np.diff(stamps)[1:]))
        rate, total = Rate(each, stamps[1] - stamps[0] - each), job.schedule.total(samples)
        note = f"{each:.3g} s a step, {rate.compiling:.0f} s to compile"
        lines.append(Line(f"train {job.name}: {total} steps", rate.compiling + total * each, note))
    return lines


def _evaluating(config: Config, sensor: sts.Sensor, data: dataset.Dataset, folder: Path) -> Line:
    """Measure the evaluation of the small experiment."""
    held_out = len(evaluation.rows_of(data, "trajectory")["test"])
    start = time.perf_counter()
    evaluate(_small(config), data, folder, sensor, "trajectory")
    return Line("evaluate and draw", time.perf_counter() - start, f"of {held_out} trajectories")


def _small(config: Config) -> Config:
    """The configuration of the small experiment that is measured."""
    collection = dataset.head(config.collection, MANY)
    return dataclasses.replace(config, collection=collection, splits=("trajectory",), rerolls=2)
