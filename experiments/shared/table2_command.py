"""`train` of `experiments.real`: train models on recorded trajectories, and write the paper's Table 2."""

import dataclasses
import tempfile
import time
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro

import sts_jax as sts
from experiments.shared import recorded, simulated, stages, table2
from experiments.shared.command import Folder
from experiments.shared.duration import Line, shown
from experiments.shared.progress import say
from experiments.shared.recorded import Config
from experiments.shared.simulated import Simulated
from sts_jax import storage

_FEW = 2, recorded.LEAST  # number of trajectories after which the time is measured. The first ones include compilation
_STEPS = 4  # number of gradient steps in a measurement


@dataclasses.dataclass(frozen=True)
class Train:
    """Train the models of the paper's Table 2 on recorded trajectories, and write the table.

    The models are VAE visual only, VAE tactile only and MVAE without pose.
    """

    # configuration of the preset. Each of its fields is an option
    config: Annotated[Config, tyro.conf.arg(name="")]
    workdir: Folder = Path("runs/real")  # work directory with the folder `dataset` and the sensor file `sensor.json`
    name: str = "table2"  # folder in the work directory for the results
    preset: Literal["smoke", "default", "paper"] = "default"  # set of default values for the options
    only: stages.Stage | None = None  # run only this stage of the experiment
    plan: bool = False  # measure each stage for a short time, print its expected duration, and stop
    debug: bool = False  # show the traceback of every error


def learn(args: Train) -> None:
    """Collect trajectories of the digital twin if there are too few, train, evaluate, and print the table.

    If the trajectories in the work directory come from a real sensor, or from a twin that `python -m experiments.twin`
    ran as a separate program, no further trajectories are collected.

    Raises:
        ValueError: An option is out of range, there are too few trajectories, or the results were made with other
            options or trajectories.
        FileNotFoundError: There is no sensor file, or a stage before `args.only` has not been run.
        LockedError: Another process works on the same results.
        OSError: A file is damaged or cannot be written.
    """
    recorded.check(args.config)
    if args.name != Path(args.name).name or args.name in ("", "dataset"):
        raise ValueError(f"--name must be the name of a folder, not a path and not 'dataset', got {args.name!r}")
    sts.enable_compilation_cache()
    folder = args.workdir / args.name
    if args.plan or (args.preset == "paper" and not (folder / "metrics.json").exists()):
        text = plan(args.config, recorded.missing(args.config, args.workdir))
        print(text, flush=True)
        if args.plan:
            return
    if args.only in (None, "collect"):
        collect(args.config, args.workdir)
    if args.only == "collect":
        return
    data = recorded.read(args.config, args.workdir)
    with storage.lock(folder):
        content = {**dataclasses.asdict(args.config), "trajectories": data.identity}
        storage.claim(folder / "config.json", content)
        if args.only in (None, "train"):
            recorded.train(args.config, data, folder)
        if args.only in (None, "evaluate"):
            print(table2.evaluate(args.config, data, args.workdir, folder))


def collect(config: Config, workdir: Path) -> None:
    """Collect trajectories of the digital twin until the work directory has `config.count` trajectories.

    If the trajectories in the work directory come from a real sensor, or from a twin that `python -m experiments.twin`
    ran as a separate program, no trajectories are collected.
    """
    count = recorded.missing(config, workdir)
    if not count:
        return
    say(f"collect: {count} trajectories of the digital twin into {workdir / 'dataset'}")
    simulated.collect(Simulated(workdir, config.count, config.size))


def plan(config: Config, missing: int) -> str:
    """Run a small part of each stage with the digital twin, and estimate the duration of the whole experiment.

    Args:
        config: Configuration of the experiment.
        missing: Number of trajectories of the digital twin that must still be collected.

    Returns:
        A text with one line for each stage, and a line for the total duration.
    """
    with tempfile.TemporaryDirectory() as name:
        workdir, clock = Path(name), [time.perf_counter()]
        for count in _FEW:
            simulated.collect(Simulated(workdir, count, config.size))
            clock.append(time.perf_counter())
        first, rest = np.diff(clock)
        each = rest / (_FEW[1] - _FEW[0])
        start = max(first - _FEW[0] * each, 0)
        lines = [
            Line(f"collect: {missing} trajectories", start + missing * each if missing else 0, f"{each:.2g} s each")
        ]
        begin = time.perf_counter()
        data = recorded.read(config, workdir)
        reading = (time.perf_counter() - begin) / _FEW[1]
        lines.append(Line(f"read: {config.count} trajectories", config.count * reading, f"{reading:.2g} s each"))
        lines += _training(config, data, workdir)
        begin = time.perf_counter()
        table2.evaluate(config, data, workdir, workdir)
        lines.append(Line("evaluate and draw", time.perf_counter() - begin, f"of {len(data.validation.number)}"))
    lines.append(Line("together", sum(line.seconds for line in lines), f"{config.count} trajectories of the twin"))
    return shown(lines)


def _training(config: Config, data: recorded.Recorded, folder: Path) -> list[Line]:
    """Estimate the duration of each training from a few steps."""
    lines, samples = [], recorded.samples(config, config.count)
    for job in recorded.jobs(config, data):
        clock = [time.perf_counter()]
        few = dataclasses.replace(job.schedule, steps=_STEPS, warmup=0, log_every=1, checkpoint_every=_STEPS)
        stages.run(
            job._replace(schedule=few),
            folder / "models" / job.name,
            config.targets,
            lambda *_, clock=clock: clock.append(time.perf_counter()),
        )
        spent = np.diff(clock)
        each, total = float(np.median(spent[1:])), job.schedule.total(samples)
        note = f"{each:.3g} s a step, {spent[0]:.0f} s to compile"
        lines.append(Line(f"train {job.name}: {total} steps", spent[0] + total * each, note))
    return lines
