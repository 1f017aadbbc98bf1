"""Export a dataset to a format of other programs.

    python -m experiments.export runs/freefall --to lerobot --out falls-lerobot                 # LeRobotDataset v3.0
    python -m experiments.export runs/freefall --to oxt --out falls-oxt                         # Open-X-Tactile, FTP-1
    python -m experiments.export runs/freefall --to parquet --out falls-parquet                 # Hugging Face datasets
    python -m experiments.export runs/freefall --to png --out falls-png --frames ends           # PNG files, and a table

One trajectory is one episode. `docs/datasets.md` describes the fields. An interrupted export leaves nothing at OUT.
"""

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

import tyro

from experiments.shared import terminal
from sts_jax.dataset import export


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of the command line."""

    # folder or URL of a finished dataset, or the work directory of an experiment
    dataset: Annotated[str, tyro.conf.Positional]
    to: Literal["lerobot", "oxt", "parquet", "png"]  # format
    out: str  # folder of the export
    # `all` exports the trajectories with images of all frames, `ends` the first and last frames of all with images
    frames: Literal["all", "ends"] = "all"


def main(args: Args) -> str:
    """Export a dataset, and state what the export has."""
    if "://" in args.out:
        raise ValueError(f"--out must be a folder of this computer, got {args.out}: copy the finished export there")
    with terminal.Bar() as bar:
        exported = export.FORMATS[args.to](
            args.dataset, Path(args.out), frames=args.frames, progress=lambda now: bar("frames", now.done, now.total)
        )
    line = f"{args.out}: {exported.frames} frames of {exported.trajectories} trajectories"
    if exported.left_out:
        line += (
            f". {exported.left_out} trajectories are left out, because not all of their frames have images: "
            "--frames ends has the first and last frames of all"
        )
    return line


if __name__ == "__main__":
    args = tyro.cli(Args, description=__doc__)
    with terminal.on_one_line():
        print(main(args))
