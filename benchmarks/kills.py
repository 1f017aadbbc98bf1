"""Random kills of the command that collects a dataset: afterwards it has the same bytes, and nothing is left over.

    python -m benchmarks.kills                                                   # 100 kills, about an hour
    python -m benchmarks.kills --out benchmarks/results/collect/kills.txt        # also write the summary
    python -m benchmarks.kills --kills 20 --processes 2                          # two processes share the work

`python -m experiments.collect` makes a small dataset, and is killed (SIGKILL) and started again. Every other kill waits
until a shard is being written. When the dataset is finished, it is compared with one that was made without kills, and
the next one begins.
"""

import contextlib
import dataclasses
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import tyro

from benchmarks.instruments.experiments import EXPERIMENTS
from sts_jax import storage

OPTIONS = (
    *("--preset", "smoke", "--num-objects", "8", "--num-per-object", "1", "--objects-per-shard", "1"),
    *("--frames", "all", "--resolution", "64", "64"),
)
LONGEST_S = 3600.0  # time limit of one start of the command
LATE_S = 0.4  # longest time from the beginning of a shard's file to a kill that waits for it


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of the command line."""

    kills: int = 100  # number of kills
    processes: int = 1  # number of processes that share the work. Each is killed at another moment
    scenario: str = "freefall"  # scenario of the dataset
    seed: int = 0  # seed of the moments
    out: Path | None = None  # text file for the summary (default: print only)

    def __post_init__(self) -> None:
        if self.kills < 1 or self.processes < 1:
            raise ValueError(f"--kills and --processes must be at least 1, got {self.kills} and {self.processes}")
        if self.scenario not in EXPERIMENTS:
            raise ValueError(f"--scenario must be one of {', '.join(EXPERIMENTS)}, got {self.scenario!r}")


@dataclasses.dataclass
class Drill:
    """Results of the kills."""

    kills: int = 0
    inside: int = 0  # kills with a shard whose files were begun and not finished
    datasets: int = 0  # finished datasets
    different: int = 0  # finished datasets with other bytes than the one that was made without kills
    left_over: int = 0  # files in finished datasets that the one without kills lacks


def content(folder: Path) -> dict[str, str]:
    """SHA-256 of all files of a folder, by their names."""
    return {path.name: storage.sha256(path) for path in folder.iterdir() if path.name != ".lock"}


def is_inside(folder: Path) -> bool:
    """Whether a shard has been begun and is not finished."""
    names = {path.name for path in folder.glob("*")} | {path.name for path in folder.glob(".*")}
    begun = {name.lstrip(".").partition(".")[0] for name in names if name.lstrip(".").startswith("shard-")}
    return any(f"{shard}.json" not in names for shard in begun)


def start(args: Args, folder: Path, index: int = 0, count: int = 1) -> subprocess.Popen:
    """Start the command."""
    words = ("--scenario", args.scenario, *OPTIONS, "--out", str(folder))
    part = ("--process-index", str(index), "--process-count", str(count))
    command = [sys.executable, "-m", "experiments.collect", *words, *part]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)


def finish(process: subprocess.Popen) -> None:
    """Wait for a process, and raise a RuntimeError with its messages if it fails."""
    try:
        _, said = process.communicate(timeout=LONGEST_S)
    finally:
        process.kill()
    if process.returncode:
        raise RuntimeError(f"the command failed with status {process.returncode}:\n{said}")


def drill(args: Args, workdir: Path) -> Drill:
    """Make datasets under kills until there were enough of them, and compare each with one made without kills."""
    reference, folder = workdir / "reference", workdir / "killed"
    finish(start(args, reference))
    begin = time.monotonic()
    finish(start(args, reference))  # all compiled, nothing to make
    idle_s = time.monotonic() - begin
    shutil.rmtree(folder, ignore_errors=True)
    expected, result, draw = content(reference), Drill(), random.Random(args.seed)
    while result.kills < args.kills:
        for index in range(args.processes):
            process = start(args, folder, index, args.processes)
            killed = _kill(process, folder, draw, waits=result.kills % 2 == 0, idle_s=idle_s)
            result.kills += killed
            result.inside += killed and is_inside(folder)
        if (folder / storage.MANIFEST).exists():
            _compare(args, folder, expected, result)
    _compare(args, folder, expected, result)
    return result


def _kill(process: subprocess.Popen, folder: Path, draw: random.Random, *, waits: bool, idle_s: float) -> bool:
    """Kill a process at a random moment, or while it writes a shard. False if it has ended before."""
    if waits:
        deadline = time.monotonic() + LONGEST_S
        before = set(folder.glob(".shard-*.partial"))
        while process.poll() is None and time.monotonic() < deadline:
            if set(folder.glob(".shard-*.partial")) - before:
                time.sleep(draw.uniform(0, LATE_S))
                break
            time.sleep(0.002)
    else:
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(draw.uniform(0.3 * idle_s, 2.5 * idle_s))
    process.send_signal(signal.SIGKILL)
    _, said = process.communicate()
    if process.returncode == -signal.SIGKILL:
        return True
    if process.returncode:
        raise RuntimeError(f"the command failed with status {process.returncode}:\n{said}")
    return False


def _compare(args: Args, folder: Path, expected: dict[str, str], result: Drill) -> None:
    """Finish a dataset without a kill, compare it, and delete it."""
    for index in range(args.processes):
        finish(start(args, folder, index, args.processes))
    actual = content(folder)
    result.datasets += 1
    result.different += any(actual.get(name) != checksum for name, checksum in expected.items())
    result.left_over += len(set(actual) - set(expected))
    shutil.rmtree(folder)


def summary(args: Args, result: Drill) -> str:
    """The results in words."""
    return (
        f"kills of `experiments.collect --scenario {args.scenario}`, {args.processes} process(es): {result.kills}\n"
        f"of these inside an open shard: {result.inside}\n"
        f"finished datasets: {result.datasets}\n"
        f"with other bytes than a dataset made without kills: {result.different}\n"
        f"files left over: {result.left_over}\n"
    )


def main(args: Args) -> None:
    """Run the drill, and print its results."""
    with tempfile.TemporaryDirectory() as workdir:
        result = drill(args, Path(workdir))
    text = summary(args, result)
    print(text, end="")
    if args.out is not None:
        storage.write_bytes(args.out, text.encode())
    if result.different or result.left_over:
        raise SystemExit("the drill has failed")


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
