"""Copy the trained model of a work directory into the library, so that `sts.Predictor.load(NAME)` loads it.

    python -m experiments.ship runs/freefall                    # writes sts_jax/models/freefall
    python -m experiments.ship runs/long --name freefall

The command copies `models/statespace` with rounded weights and without the optimiser's state. It prints the size of the
copy, and the largest differences between predictions of the original and of the copy. A model of more than 12 MB is
refused. An earlier model of the same name is replaced when the new one is complete.
"""

import dataclasses
import tempfile
from pathlib import Path
from typing import Annotated

import jax
import numpy as np
import tyro

import sts_jax as sts
from experiments.shared import run, terminal
from sts_jax.predict import MODELS

LIMIT = 12e6  # largest size of a model's folder (bytes)
NUM = 16  # number of bottles from whose images both models predict
LIFT = 0.04  # height of every second bottle above the pad (m), because models of freefall see objects in the air


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of the command line."""

    workdir: Annotated[run.Folder, tyro.conf.Positional]  # work directory of an experiment
    name: str | None = None  # name of the model in the library. None: the name of the work directory


def ship(workdir: Path, name: str) -> str:
    """Copy a trained model to `sts_jax/models/NAME`, with rounded weights, and describe the copy in one line."""
    if not name.isidentifier():
        raise ValueError(f"--name must be letters, digits and underscores, without a digit first, got {name!r}")
    original = sts.Predictor.load(workdir / "models" / "statespace")
    MODELS.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory(dir=MODELS, prefix=".") as temporary:
        new, old = Path(temporary) / "new", Path(temporary) / "old"
        original.save(new, compact=True)
        size = sum(path.stat().st_size for path in new.rglob("*") if path.is_file())
        if size > LIMIT:
            raise ValueError(f"the model of {workdir} has {size / 1e6:.1f} MB, but the limit is {LIMIT / 1e6:g} MB")
        line = f"{name}: {size / 1e6:.1f} MB of at most {LIMIT / 1e6:g}; {compare(original, sts.Predictor.load(new))}"
        if (MODELS / name).exists():
            (MODELS / name).rename(old)
        new.rename(MODELS / name)
    return line


def compare(original: sts.Predictor, rounded: sts.Predictor) -> str:
    """A line with the largest differences between predictions of two models from images of `bottles`."""
    visual = bottles(original.preprocessing)
    half = np.array(original.preprocessing.condition_scale, np.float32) / 2
    condition = np.tile(half, (len(visual), 1)) if half.size else None
    a, b = (predictor(visual=visual, condition=condition) for predictor in (original, rounded))
    image = np.abs(np.asarray(a.visual) - np.asarray(b.visual)).max()
    apart = 1e3 * np.linalg.norm(np.asarray(a.pose)[:, :3] - np.asarray(b.pose)[:, :3], axis=-1)
    return (
        f"largest difference of predictions from {len(visual)} visual images: {image:.4f} in the visual image, "
        f"{apart.max():.3f} mm in position (median {np.median(apart):.3f} mm)"
    )


def bottles(view: sts.training.Preprocessing) -> np.ndarray:
    """Render visual images of bottles, alternately at rest on the pad and in the air, (NUM, height, width, 3)."""
    sensor, images = sts.Sensor(), []
    for number in range(NUM):
        body = sts.objects.make(jax.random.key(number), "bottle")
        lift = LIFT * (number % 2)
        pose, wrench = sts.physics.place(body, sensor, yaw=float(number))
        pose, wrench = pose + np.array([0, 0, lift, 0, 0, 0, 0], np.float32), wrench * (lift == 0)
        images.append(sts.sense(sensor, body, pose, wrench, resolution=view.resolution, crop=view.crop).visual)
    return np.stack(images)


if __name__ == "__main__":
    args = tyro.cli(Args, description=__doc__)
    with terminal.on_one_line():
        sts.enable_compilation_cache()
        print(ship(args.workdir, args.name or args.workdir.resolve().name))
