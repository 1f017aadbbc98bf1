"""Speed, memory and size of collected datasets, of reading them, and of training from the disk.

    python -m benchmarks.collect --out benchmarks/results/collect/collect.md    # 15 minutes to an hour on two CPU cores
    python -m benchmarks.collect --preset smoke --scenarios freefall --steps 4  # minutes, for a first look

1. The stages of one shard: objects, physics, rendering and writing, each in this process with its peak memory.
2. `python -m experiments.collect` makes the dataset of each scenario from start to end, beside the time of all stages
   one after the other. Finished ones in `--workdir` are not made again.
3. Random frames per second from the disk, and an epoch of the paper's one-step model from the disk and from memory.
4. The costs of 10 million trajectories, derived from these.
"""

import dataclasses
import os
import platform
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import numpy as np
import tyro

import sts_jax as sts
from benchmarks.instruments.experiments import EXPERIMENTS
from experiments.shared.config import Config
from sts_jax import dataset, evaluation, storage, training
from sts_jax.dataset import records, shards
from sts_jax.dataset.rendering import render

MILLIONS = 10_000_000  # trajectories of the last table
BATCHES = (64, 1024)  # numbers of random frames of one read
READ_S = 10.0  # duration of the random reads
CARD_LINES = 45  # first lines of each data card that are shown


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of the command line."""

    scenarios: tuple[str, ...] = ("freefall", "inclined", "perturbed")  # scenarios whose datasets are made
    preset: Literal["smoke", "default", "paper"] = "paper"  # preset of `experiments.collect`
    steps: int = 60  # gradient steps from the disk and from memory, of which an epoch is a multiple
    workdir: Path = Path("runs/collect")  # folder of the datasets
    out: Path | None = None  # Markdown file for the tables (default: print only)

    def __post_init__(self) -> None:
        if not self.scenarios or set(self.scenarios) - set(EXPERIMENTS):
            raise ValueError(f"--scenarios must be some of {', '.join(EXPERIMENTS)}, got {self.scenarios}")
        if self.steps < 2:
            raise ValueError(f"--steps must be at least 2, got {self.steps}")


class Stage(NamedTuple):
    """One stage of a shard."""

    name: str
    seconds: float
    trajectories: int
    frames: int
    peak_mb: float  # largest resident memory of the process meanwhile (MB)


class Whole(NamedTuple):
    """A dataset made from start to end."""

    seconds: float
    size: int  # bytes of all files
    peak_mb: float  # largest resident memory of the process (MB)


def measured(call: Callable[[], Any]) -> tuple[Any, float, float]:
    """Call a function a first time, which compiles, and again. Return its result, its seconds and the peak memory."""
    call()
    peak, over = 0, threading.Event()

    def watch() -> None:
        nonlocal peak
        while not over.wait(0.01):
            peak = max(peak, int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE"))

    watcher = threading.Thread(target=watch)
    watcher.start()
    begin = time.perf_counter()
    result = call()
    seconds = time.perf_counter() - begin
    over.set()
    watcher.join()
    return result, seconds, peak / 1e6


def stages(collection: dataset.Collection) -> list[Stage]:
    """Measure the stages of the first shard of a dataset."""
    sensor, members = sts.Sensor(), np.arange(min(collection.objects_per_shard, collection.num_objects))
    bodies, making_s, making_mb = measured(lambda: dataset.make_bodies(collection, members))
    _, physics_s, physics_mb = measured(
        lambda: sts.physics.simulate(
            jax.random.key(0), bodies, sensor, collection.scenario, collection.num_per_object, engine=collection.engine
        ).pose.block_until_ready()
    )
    shard = shards.simulate_shard(collection, sensor, 0, lambda _: None)
    given = collection, sensor, shard.bodies, shard.trajectory, shard.frames, shard.views, lambda _: None
    batches, rendering_s, rendering_mb = measured(lambda: list(render(*given)))
    with tempfile.TemporaryDirectory() as folder:
        _, writing_s, writing_mb = measured(lambda: records.write_images(Path(folder) / "images", batches))
    trajectories, frames = len(members) * collection.num_per_object, len(shard.frames) + len(shard.views["body"])
    return [
        Stage("objects", making_s, trajectories, 0, making_mb),
        Stage("physics", physics_s, trajectories, 0, physics_mb),
        Stage("rendering", rendering_s, 0, frames, rendering_mb),
        Stage("writing", writing_s, 0, frames, writing_mb),
    ]


def whole(args: Args, scenario: str) -> Whole:
    """Make a dataset with the command, unless it is finished, and note its time."""
    folder, note = args.workdir / f"{scenario}-{args.preset}", args.workdir / f"{scenario}-{args.preset}.json"
    if not note.exists():
        if (folder / storage.MANIFEST).exists():
            raise ValueError(f"{folder} is finished, but its time was not noted: delete it, or give another --workdir")
        command = [sys.executable, "-m", "experiments.collect", "--scenario", scenario, "--preset", args.preset]
        begin = time.perf_counter()
        with subprocess.Popen([*command, "--out", str(folder)]) as process:
            _, status, used = os.wait4(process.pid, 0)
            process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            raise RuntimeError(f"{' '.join(command)} failed")
        size = sum(path.stat().st_size for path in folder.iterdir())
        scale = 1 if sys.platform == "darwin" else 1024
        storage.write_json(note, [time.perf_counter() - begin, size, used.ru_maxrss * scale / 1e6])
    return Whole(*storage.read_json(note, f"delete {note}"))


def reading(data: dataset.Dataset, batch: int) -> float:
    """Random stored frames (both images and the segmentation) that are read per second."""
    draw = np.random.default_rng(0)
    opened: dict[int, records.Shard] = {}
    data.images(draw.integers(len(data.frames), size=batch), opened=opened)
    begin, count = time.perf_counter(), 0
    while time.perf_counter() - begin < READ_S:
        data.images(draw.integers(len(data.frames), size=batch), opened=opened)
        count += batch
    return count / (time.perf_counter() - begin)


def epoch(config: Config, data: dataset.Dataset, steps: int, *, in_memory: bool) -> float:
    """Seconds of an epoch of the paper's one-step model, from the mean time of some steps."""
    rows, blank = evaluation.rows_of(data, "object"), dataset.empty_frame(sts.Sensor(), config.collection).tactile
    modalities, full = ("visual", "tactile", "pose"), data.full_trajectories()
    chosen = rows["train"][np.isin(rows["train"], full)]
    arrays, view = training.step_arrays(data, chosen, modalities, config.preprocessing, blank, in_memory=in_memory)
    model = training.paper_model(modalities, view)
    schedule = dataclasses.replace(config.training, steps=steps + 2, log_every=steps + 2, checkpoint_every=steps + 2)
    stamps: list[float] = []
    with tempfile.TemporaryDirectory() as folder:
        training.train(
            schedule,
            model,
            arrays,
            workdir=Path(folder) / "model",
            absent=view.absent,
            progress=lambda *_: stamps.append(time.perf_counter()),
        )
    each = (stamps[-2] - stamps[0]) / (len(stamps) - 2)  # without compiling, and without the checkpoint
    return each * len(next(iter(arrays.targets.values()))) / config.training.batch_size


def main(args: Args) -> str:
    """Measure everything, and return the tables."""
    sts.enable_compilation_cache()
    cores = os.cpu_count() or 1
    lines = [
        "# Collecting, reading and training",
        "",
        f"Preset `{args.preset}`, {platform.machine()}, {cores} CPU cores, JAX on {jax.default_backend()}.",
        "",
        "| scenario | stage | trajectories/s | frames/s | peak memory (MB) |",
        "|---|---|---|---|---|",
    ]
    configs = {name: EXPERIMENTS[name].PRESETS[args.preset] for name in args.scenarios}
    alone = dict.fromkeys(configs, 0.0)  # seconds of all stages one after the other
    for name, config in configs.items():
        collection = config.collection
        each = [shards.planned(collection, index) for index in range(collection.num_shards)]
        trajectories, frames = (sum(numbers) for numbers in zip(*each, strict=True))
        for stage in stages(collection):
            work = trajectories / stage.trajectories if stage.trajectories else frames / stage.frames
            alone[name] += stage.seconds * work
            rates = (f"{number / stage.seconds:,.1f}" if number else "" for number in stage[2:4])
            lines.append(f"| {name} | {stage.name} | {' | '.join(rates)} | {stage.peak_mb:,.0f} |")
    lines += [
        "",
        "| dataset | trajectories | frames | minutes | minutes without overlap | GB | peak memory (MB) |",
    ]
    lines += ["|---|---|---|---|---|---|---|"]
    made = {name: whole(args, name) for name in args.scenarios}
    opened = {name: dataset.load(args.workdir / f"{name}-{args.preset}") for name in args.scenarios}
    for name, one in made.items():
        data = opened[name]
        lines.append(
            f"| {name} | {len(data.trajectory['outcome']):,} | {len(data.frames):,} | {one.seconds / 60:.1f} | "
            f"{alone[name] / 60:.1f} | {one.size / 1e9:.2f} | {one.peak_mb:,.0f} |"
        )
    first = args.scenarios[0]
    disk, memory = (epoch(configs[first], opened[first], args.steps, in_memory=which) for which in (False, True))
    lines += [
        "",
        "| reading and training | |",
        "|---|---|",
        *(f"| random frames/s, {first}, batches of {n:,} | {reading(opened[first], n):,.0f} |" for n in BATCHES),
        f"| epoch from the disk (s) | {disk:,.0f} |",
        f"| epoch from memory (s) | {memory:,.0f} |",
        f"| ratio | {disk / memory:.2f} |",
        "",
        f"{MILLIONS:,} trajectories at the rates of these datasets:",
        "",
        "| scenario | core-hours | TB |",
        "|---|---|---|",
    ]
    for name, one in made.items():
        times = MILLIONS / len(opened[name].trajectory["outcome"])
        lines.append(f"| {name} | {times * one.seconds * cores / 3600:,.0f} | {times * one.size / 1e12:,.2f} |")
    for name in args.scenarios:
        card = args.workdir / f"{name}-{args.preset}" / "README.md"
        if card.exists():
            shown = card.read_text().splitlines()[:CARD_LINES]
            lines += ["", f"The first lines of the card of {name}:", "", "```markdown", *shown, "```"]
    text = "\n".join(lines) + "\n"
    if args.out is not None:
        storage.write_bytes(args.out, text.encode())
    return text


if __name__ == "__main__":
    print(main(tyro.cli(Args, description=__doc__)), end="")
