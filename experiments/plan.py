"""How long an experiment will take, from a short measurement."""

import dataclasses
import tempfile
import time
from pathlib import Path

import numpy as np

import sts_jax as sts
from experiments import stages
from experiments.progress import Bar
from sts_jax import dataset


def plan(config: stages.Config, *, num: int = 64, steps: int = 4) -> str:
    """Seconds a stage, measured on a little of each and everything twice, so that compilation counts once.

    Args:
        config: The experiment.
        num: Trajectories to simulate. Each has its first and last frame rendered in all symmetries.
        steps: Gradient steps of each model.

    Returns:
        One line a stage.
    """
    sensor, collection = sts.Sensor(), config.collection
    many = 8  # objects
    lines = []
    with tempfile.TemporaryDirectory() as name, Bar() as bar:
        spent: dict[str, list[float]] = {"trajectories": [], "frames": []}
        for seed in (0, 1):
            little = dataclasses.replace(
                dataset.head(collection, many),
                num_per_object=num // many,
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

            dataset.collect(little, sensor, Path(name) / str(seed), progress=watch)
            spent["trajectories"].append(stamps["trajectories"] - stamps["start"])
            spent["frames"].append(stamps["frames"] - stamps["trajectories"])
        last, seen = collection.scenario.frames, len(dataset.symmetries_of(collection))
        rendered = collection.num_objects * collection.rendered_per_object
        rerolled = min(config.num_rerolled, round(collection.shares[2] * rendered)) * config.rerolls
        frames = rendered * 2 * seen + min(collection.num_full, rendered) * (last - 2)
        frames += collection.num_objects * collection.num_views
        rerolling = 0.0
        for stage, total, measured in (
            ("trajectories", collection.num_trajectories, num),
            ("frames", frames, 2 * len(collection.scenario.symmetries) * num),
        ):
            first, again = spent[stage]
            rate = measured / again
            seconds = max(first - again, 0) + total / rate
            lines.append(
                (f"collect: {total} {stage}", seconds, f"{rate:.3g} a second, {first - again:.0f} s to compile")
            )
            rerolling += rerolled / rate
        lines.append((f"ceilings: {rerolled} trajectories", rerolling, "simulated and drawn at the same rates"))

        data = dataset.load(Path(name) / "0")
        tiny = dataclasses.replace(config, collection=dataset.head(collection, many), splits=("trajectory",), rerolls=2)
        pairs = data.pairs(np.arange(num), symmetries=True)
        samples = round(stages.train_share(collection.shares, config.splits[0]) * rendered) * seen
        for job in stages.jobs(config, sensor, pairs):
            stamps_of_steps = [time.perf_counter()]

            def tick(
                done: int, total: int, _: dict, stamps: list[float] = stamps_of_steps, name: str = job.name
            ) -> None:
                stamps.append(time.perf_counter())
                bar(f"plan: train {name}", done, total)

            few = dataclasses.replace(job.schedule, steps=steps, warmup=0, log_every=1, checkpoint_every=steps)
            folder = stages.model_folder(Path(name), job.name, tiny, "trajectory")
            stages.run(job._replace(schedule=few), folder, config.targets, tick)
            each = float(np.median(np.diff(stamps_of_steps)[1:]))
            compiling = stamps_of_steps[1] - stamps_of_steps[0] - each
            total = job.schedule.total(samples)
            note = f"{each:.3g} s a step, {compiling:.0f} s to compile"
            lines.append((f"train {job.name}: {total} steps", compiling + total * each, note))
        held_out = len(stages.rows_of(data, "trajectory")["test"])
        start = time.perf_counter()
        stages.evaluate(tiny, data, Path(name), sensor, "trajectory")
        lines.append(("evaluate and draw", time.perf_counter() - start, f"of {held_out} trajectories"))
    repeats = len(config.splits)
    lines = [(what, seconds * (1 if what.startswith("collect") else repeats), note) for what, seconds, note in lines]
    lines.append(("together", sum(seconds for _, seconds, _ in lines), f"for {', '.join(config.splits)} split"))
    return "\n".join(f"{what:<36}{seconds:>9.0f} s   ({note})" for what, seconds, note in lines)
