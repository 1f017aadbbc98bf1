"""Learning from recorded trajectories: reading, training arrays, and the training of the models of Table 2."""

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

import sts_jax as sts
from experiments.shared import stages
from experiments.shared.config import MODELS
from experiments.shared.progress import Bar
from sts_jax import _files, hardware, training
from sts_jax.hardware import twin
from sts_jax.training import TrainConfig

NAMES = ("vae-visual", "vae-tactile", "mvae-without-pose")  # the rows of the paper's Table 2
LEAST = 5  # trajectories, so that one of them can be held out


@dataclasses.dataclass(frozen=True)
class Config:
    """How the models of Table 2 are trained and evaluated."""

    training: TrainConfig
    count: int = 100  # trajectories that the digital twin collects if the work directory has none of a device
    size: tuple[int, int] = (640, 480)  # width and height of the twin's images, pixels
    steps: tuple[int, int, int] | None = None  # gradient steps of the three models (None: training.epochs decides)
    # a subset of modalities is trained to predict all targets, or its own (paper)
    targets: Literal["all", "own"] = "all"
    rest: bool = True  # train that an object at rest stays, too: the final pair is a second input of each trajectory
    # copies of each training trajectory at other places of the pad, up to `largest_shift` away, see training.shifted
    shifts: int = 15
    largest_shift: int = 8  # pixels of the view, of 2.3 mm each at 64 pixels
    image_size: int = 64  # pixels, side of the views (paper)
    held_out: float = 0.2  # share of the trajectories for validation (paper)
    seed: int = 0  # of the split
    num_shown: int = 6  # validation trajectories in the figure


class Recorded(NamedTuple):
    """Recorded trajectories as the sensor's pinhole sees them, and the images of its empty pad."""

    train: hardware.Moments
    validation: hardware.Moments
    empty: dict[str, np.ndarray]  # by stream, uint8 (size, size, 3)
    identity: str  # of the trajectories and the sensor file
    source: str  # of the images, for titles


def check(config: Config) -> None:
    """Check the configuration.

    Raises:
        ValueError: A field is out of range.
    """
    if not 0 < config.held_out < 1:
        raise ValueError(f"held_out must be a share between 0 and 1, got {config.held_out}")
    if config.shifts < 0 or not 0 <= config.largest_shift < config.image_size:
        raise ValueError(
            f"shifts must be >= 0 and largest_shift in [0, {config.image_size}) pixels, got {config.shifts} and "
            f"{config.largest_shift}"
        )
    if config.count < LEAST:
        raise ValueError(f"count must be >= {LEAST}, got {config.count}")
    if config.num_shown < 1:
        raise ValueError(f"num_shown must be >= 1, got {config.num_shown}")
    training.paper_model(("visual",), training.Preprocessing((config.image_size, config.image_size)))  # size fits


def read(config: Config, workdir: Path) -> Recorded:
    """Read, rectify and split the confirmed trajectories of a work directory.

    Raises:
        FileNotFoundError: There is no session, or no sensor file.
        ValueError: There are too few trajectories, the sensor file has no backgrounds, or it is of another sensor.
        OSError: A file is damaged.
    """
    recordings = hardware.load_recordings(workdir / "dataset")
    device, sensor = sensor_file(workdir)
    if len(recordings) < LEAST:
        raise ValueError(
            f"{recordings.folder} has {len(recordings)} confirmed trajectories, but at least {LEAST} are needed: "
            "collect more, or confirm some with `python -m experiments.real review --confirm`"
        )
    size = (config.image_size, config.image_size)
    with Bar() as bar:
        found = hardware.moments(
            recordings,
            device.lens,
            sensor.camera,
            size,
            progress=lambda done, total: bar("read", done, total),
        )
    empty = {
        stream: hardware.rectified(device.lens, sensor.camera, device.background(workdir, stream), size)
        for stream in ("visual", "tactile")
    }
    order = np.random.default_rng(config.seed).permutation(len(recordings))
    cut = min(max(round((1 - config.held_out) * len(order)), 1), len(order) - 1)
    train, validation = (
        hardware.Moments(*(leaf[np.sort(rows)] for leaf in found)) for rows in (order[:cut], order[cut:])
    )
    source = "a digital twin" if is_twin(recordings) else f"the sensor {recordings.session['camera']}"
    return Recorded(train, validation, empty, identity(workdir, recordings), source)


def is_twin(recordings: hardware.Recordings) -> bool:
    """Whether the trajectories are of a digital twin, whose LED controller has a serial number of its own kind."""
    return str(recordings.session["leds"]).startswith("TWIN")


def missing(config: Config, workdir: Path) -> int:
    """The number of trajectories that the twin on its virtual clock has to collect: none if there are some of a device.

    Raises:
        OSError: `session.json` is damaged.
    """
    if not (workdir / "dataset" / hardware.recordings.SESSION).exists():
        return config.count
    recordings = hardware.load_recordings(workdir / "dataset")
    return max(config.count - len(recordings), 0) if recordings.session["camera"] == twin.CAMERA else 0


def samples(config: Config, count: int) -> int:
    """The number of training samples of some trajectories."""
    return round((1 - config.held_out) * count) * (1 + config.shifts) * (2 if config.rest else 1)


def sensor_file(workdir: Path) -> tuple[hardware.Device, sts.Sensor]:
    """The device and the sensor of a work directory.

    Raises:
        FileNotFoundError: There is none.
        ValueError: It is damaged, or has no backgrounds.
    """
    path = workdir / "sensor.json"
    if not path.exists():
        raise FileNotFoundError(
            f"{path} is missing, which holds the lens and the images of the empty pad: copy the sensor file and its "
            "background images of `python -m experiments.commission` into the work directory"
        )
    device = hardware.Device.load(path)
    if device.background_visual is None or device.background_tactile is None:
        raise ValueError(
            f"{path} names no background images, and contacts are found by comparison with them: run `python -m "
            "experiments.commission` again, and copy the sensor file and its images into the work directory"
        )
    return device, sts.Sensor.load(path)


def identity(workdir: Path, recordings: hardware.Recordings) -> str:
    """SHA-256 of the trajectories and of the sensor file, which names the checksums of its images."""
    return _files.digest({"dataset": recordings.identity, "sensor": _files.sha256(workdir / "sensor.json")})


def jobs(config: Config, data: Recorded) -> Iterator[stages.Job]:
    """The trainings of the three models."""
    size, blank = (config.image_size, config.image_size), data.empty["tactile"]
    preprocessing = training.touch_of_noisy_images(training.Preprocessing(size), data.train.tactile[:, 0], blank)
    visual, tactile = (augmented(config, getattr(data.train, name), data.empty[name]) for name in ("visual", "tactile"))
    for number, name in enumerate(NAMES):
        modalities = MODELS["paper"][name]
        arrays, own = training.image_moments(visual, tactile, modalities, preprocessing, blank)
        if own.absent:
            raise ValueError(
                "no first tactile image of the training trajectories shows a contact: draw them with `python -m "
                "experiments.real review --sheet review.png`, and compare them with the background of sensor.json"
            )
        schedule = config.training
        if config.steps is not None:
            schedule = dataclasses.replace(schedule, steps=config.steps[number])
        yield stages.Job(name, schedule, training.paper_model(modalities, own), arrays, own, data.empty)


def augmented(config: Config, images: np.ndarray, empty: np.ndarray) -> np.ndarray:
    """The training trajectories of a stream, with their shifted copies, and with the moment at rest as a second input.

    Args:
        config: The experiment.
        images: First and last images, uint8 (n, 2, size, size, 3).
        empty: The image of the empty pad, uint8 (size, size, 3).
    """
    random, far = np.random.default_rng(config.seed), config.largest_shift
    parts = [images]
    for _ in range(config.shifts):
        parts.append(training.shifted(images, empty, random.integers(-far, far + 1, (len(images), 2))))
    if config.rest:
        parts += [part[:, [1, 1]] for part in parts]
    return np.concatenate(parts)


def train(config: Config, data: Recorded, folder: Path) -> None:
    """Train the models, each with a progress bar."""
    for job in jobs(config, data):
        with Bar() as bar:

            def show(done: int, total: int, record: dict[str, float], bar: Bar = bar, name: str = job.name) -> None:
                bar(f"train {name}", done, total, f"loss {record['loss']:.4g}" if record else "")

            stages.run(job, folder / "models" / job.name, config.targets, show)
