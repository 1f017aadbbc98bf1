"""Copy the trained model of a work directory into the library, so that `sts.Predictor.load(NAME)` loads it.

    python -m experiments.ship runs/freefall                    # writes sts_jax/models/freefall
    python -m experiments.ship runs/long --name freefall

The command copies `models/statespace` with rounded weights and without the optimiser's state. A model of more than
12 MB is refused. An earlier model of the same name is replaced when the new one is complete. `benchmarks.shipped`
evaluates the copy.
"""

import dataclasses
import tempfile
from pathlib import Path
from typing import Annotated

import tyro

import sts_jax as sts
from experiments.shared import terminal
from sts_jax.predict import MODELS

LIMIT = 12e6  # largest size of a model's folder (bytes)


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of the command line."""

    workdir: Annotated[Path, tyro.conf.Positional]  # work directory of an experiment
    name: str | None = None  # name of the model in the library. None: the name of the work directory


def ship(workdir: Path, name: str) -> str:
    """Copy a trained model to `sts_jax/models/NAME`, with rounded weights, and state its size."""
    if not name.isidentifier():
        raise ValueError(f"--name must be letters, digits and underscores, without a digit first, got {name!r}")
    original = sts.Predictor.load(workdir / "models" / "statespace")
    MODELS.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory(dir=MODELS, prefix=".") as temporary:
        new, old = Path(temporary) / "new", Path(temporary) / "old"
        original.save(new, compact=True)
        sts.Predictor.load(new)  # raises an error if the copy is damaged
        size = sum(path.stat().st_size for path in new.rglob("*") if path.is_file())
        if size > LIMIT:
            raise ValueError(f"the model of {workdir} has {size / 1e6:.1f} MB, but the limit is {LIMIT / 1e6:g} MB")
        if (MODELS / name).exists():
            (MODELS / name).rename(old)
        new.rename(MODELS / name)
    return f"{name}: {size / 1e6:.1f} MB of at most {LIMIT / 1e6:g}"


if __name__ == "__main__":
    args = tyro.cli(Args, description=__doc__)
    with terminal.on_one_line():
        print(ship(args.workdir, args.name or args.workdir.resolve().name))
