"""Copy the trained model of a work directory into the library, so that `sts.Predictor.load(NAME)` loads it.

    python -m experiments.ship runs/freefall                    # writes sts_jax/models/freefall
    python -m experiments.ship runs/long --name freefall --calibration datasets/others

The command copies `models/statespace` with rounded weights and without the optimiser's state. A model of more than
12 MB is refused. An earlier model of the same name is replaced when the new one is complete. `benchmarks.shipped`
evaluates the copy.

An experiment calibrates its model on few objects, so the calibration is noisy. With `--calibration`, the copy is
calibrated on all trajectories of another dataset, which `experiments.collect` makes with another `--seed`.
"""

import dataclasses
import tempfile
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

import sts_jax as sts
from experiments.shared import terminal
from sts_jax import dataset, physics, statespace, storage, training
from sts_jax.predict import MODELS

LIMIT = 12e6  # largest size of a model's folder (bytes)


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of the command line."""

    workdir: Annotated[Path, tyro.conf.Positional]  # work directory of an experiment
    name: str | None = None  # name of the model in the library. None: the name of the work directory
    # dataset of the same scenario with other objects, on which the copy is calibrated. None: the calibration is copied
    calibration: Path | None = None


def ship(workdir: Path, name: str, calibration: Path | None = None) -> str:
    """Copy a trained model to `sts_jax/models/NAME`, with rounded weights, and state its size."""
    if not name.isidentifier():
        raise ValueError(f"--name must be letters, digits and underscores, without a digit first, got {name!r}")
    original = sts.Predictor.load(workdir / "models" / "statespace")
    MODELS.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory(dir=MODELS, prefix=".") as temporary:
        new, old = Path(temporary) / "new", Path(temporary) / "old"
        original.save(new, compact=True)
        if calibration is not None:
            calibrate(new, _others(calibration, workdir / "config.json"))
        sts.Predictor.load(new)  # raises an error if the copy is damaged
        size = sum(path.stat().st_size for path in new.rglob("*") if path.is_file())
        if size > LIMIT:
            raise ValueError(f"the model of {workdir} has {size / 1e6:.1f} MB, but the limit is {LIMIT / 1e6:g} MB")
        if (MODELS / name).exists():
            (MODELS / name).rename(old)
        new.rename(MODELS / name)
    return f"{name}: {size / 1e6:.1f} MB of at most {LIMIT / 1e6:g}"


def _others(folder: Path, config: Path) -> dataset.Dataset:
    """Load a dataset, whose seed must differ from that of the work directory with the configuration `config`."""
    data = dataset.load(folder)
    if not config.exists():
        return data
    trained = storage.read_json(config, "")["collection"]
    scenario = {name: value for name, value in data.collection["scenario"].items() if name != "name"}
    if changes := storage.differences(trained["scenario"], scenario):
        raise ValueError(f"--calibration {folder}: the model has {changes}: give a dataset of the same scenario")
    if trained["seed"] == data.collection["seed"]:
        raise ValueError(
            f"--calibration {folder} has the seed {data.collection['seed']} of the training objects, on which a model "
            "is too certain: give a dataset with another seed"
        )
    return data


def calibrate(folder: Path, data: dataset.Dataset) -> None:
    """Calibrate the state-space model in a folder on all trajectories of a dataset that have images."""
    model = sts.Predictor.load(folder)
    config = model.model.config
    assert isinstance(config, statespace.Config), config  # of the folder `models/statespace`
    content = dict(data.collection["scenario"])
    scenario = storage.decode(getattr(physics, content.pop("name")), content, "scenario")
    pairs = dataset.reduced(data.pairs(data.rendered()), config.input_size)
    empty = {name: np.round(255 * image).astype(np.uint8) for name, image in model.empty.items()}
    training.calibrate(folder, training.state_arrays(pairs, config, scenario, model.preprocessing, empty))
    (folder / ".lock").unlink()  # of the calibration, which has ended


if __name__ == "__main__":
    args = tyro.cli(Args, description=__doc__)
    with terminal.on_one_line():
        print(ship(args.workdir, args.name or args.workdir.resolve().name, args.calibration))
