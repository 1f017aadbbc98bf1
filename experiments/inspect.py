"""Look at a dataset: draw it on one HTML page that opens offline, and find suspicious frames.

    python -m experiments.inspect runs/freefall                          # writes inspect.html
    python -m experiments.inspect runs/freefall --trajectory 17          # with the film of trajectory 17
    python -m experiments.inspect runs/freefall --rrd fall.rrd           # the trajectory also for the viewer of rerun

The page has counts, the shares of outcomes and classes, ranges, distributions, contact sheets of both streams, a
trajectory as a film, and the suspicious frames, which are also printed. `--rrd` needs the extra `view`.
"""

import dataclasses
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

import sts_jax as sts
from experiments.shared import drawing, inspecting, terminal, viewing
from sts_jax import dataset, storage

PRINTED = 20  # largest number of suspects that are printed


@dataclasses.dataclass(frozen=True)
class Config:
    """Options of the command line."""

    dataset: Annotated[str, tyro.conf.Positional]  # folder of a dataset, or work directory of an experiment
    out: Path = Path("inspect.html")  # file of the page
    # trajectory of the film and of --rrd. None: one with images of all frames
    trajectory: int | None = None
    rrd: Path | None = None  # also write the trajectory to this file, for the viewer of rerun
    num: int = 12  # number of trajectories on the contact sheet of each outcome
    # examine this number of frames, spread evenly over the dataset. None: all
    examine: int | None = None
    debug: bool = False  # show the traceback of every error


def open_dataset(source: str) -> dataset.Dataset:
    """Load a dataset. The error for a session of a real sensor names the command that draws one."""
    for folder in (Path(source), Path(source) / "dataset"):
        if (folder / "trajectories").is_dir() and not (folder / "collection.json").exists():
            workdir = folder.parent if folder.name == "dataset" else "WORKDIR"
            raise ValueError(
                f"{folder} is a session of a real sensor or its twin, and no simulated dataset. `python -m "
                f"experiments.real review --workdir {workdir} --check --sheet review.png` checks and draws a session, "
                "which must be in the folder `dataset` of the work directory"
            )
    return dataset.load(source)


def untouched(data: dataset.Dataset) -> np.ndarray | None:
    """The tactile image of the untouched pad, or None if it differs from one cropped image to the next."""
    seen = dataset.find_untouched(data)
    if seen is not None:
        return seen
    drawn = dataset.empty_frame(inspecting.sensor_of(data), inspecting.collection_of(data)).tactile
    return drawn if not data.collection["crop"] or (drawn == drawn[0, 0]).all() else None


def main(config: Config) -> None:
    """Load and examine a dataset, print what is suspicious, and write the page."""
    terminal.check_numbers(config, num=(0, 1000), examine=(0, 10**9))
    if config.rrd is not None:
        viewing.check_installed()
    for option, path in (("--out", config.out), ("--rrd", config.rrd)):
        if path is not None and path.is_dir():
            raise ValueError(f"{option} {path} is a folder: give the name of a file")
    data = open_dataset(config.dataset)
    number, count = config.trajectory, len(data.trajectory["outcome"])
    if number is not None and number not in data.rendered():
        reason = "has no images" if 0 <= number < count else f"does not exist: there are 0 to {count - 1}"
        raise ValueError(f"--trajectory {number} {reason}. One with images is {data.rendered()[:1].tolist()}")
    if number is None:
        number = inspecting.default_trajectory(data, inspecting.Described(data))
    if config.rrd is not None and number is None:
        raise ValueError(f"--rrd {config.rrd} needs images, but {config.dataset} has none")
    drawing.make_folder(config.out.parent)
    rows, notes = np.arange(len(data.frames)), []
    if config.examine is not None and config.examine < len(rows):
        notes.append(f"Only {config.examine:,} of {len(rows):,} frames were examined.")
        rows = np.unique(np.linspace(0, len(rows) - 1, config.examine).astype(int))
    if (skin := untouched(data)) is None:
        notes.append(
            "Blank touches were not searched, because the untouched skin looks different in each cropped image."
        )
    with terminal.Bar() as bar:
        suspects = dataset.find_suspects(
            data,
            inspecting.sensor_of(data),
            skin,
            rows=rows,
            progress=lambda done: bar("examine frames", done, len(rows)),
        )
    for one in suspects[:PRINTED]:
        print(inspecting.named(one))
    text = inspecting.page(data, config.dataset, suspects, num=config.num, trajectory=number, notes=notes)
    storage.write_bytes(config.out, text.encode())
    more = f", {len(suspects) - PRINTED:,} of them only on the page" if len(suspects) > PRINTED else ""
    print(f"{config.out}: {len(text) / 1e6:.1f} MB, {len(rows):,} frames, {len(suspects):,} suspicious{more}")
    if config.rrd is not None and number is not None:
        viewing.write_rrd(config.rrd, data, number)
        print(f"{config.rrd}: trajectory {number}, open it with `rerun {config.rrd}`")


if __name__ == "__main__":
    sts.enable_compilation_cache()
    config = tyro.cli(Config, description=__doc__)
    with terminal.on_one_line(debug=config.debug):
        main(config)
