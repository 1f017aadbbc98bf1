"""Reads recorded trajectories, and trains the models of the paper's Table 2 on them."""

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

import sts_jax as sts
from experiments.shared import stages
from experiments.shared.config import MODELS
from experiments.shared.progress import Bar
from sts_jax import hardware, storage, training
from sts_jax.hardware import twin
from sts_jax.training import TrainConfig

NAMES = ("vae-visual", "vae-tactile", "mvae-without-pose")  # the rows of the paper's Table 2
LEAST = 5  # smallest number of trajectories, so that one of them can be held out


@dataclasses.dataclass(frozen=True)
class Config:
    """Options to train and evaluate the models of the paper's Table 2 on recorded trajectories."""

    training: TrainConfig  # options of the training
    # number of trajectories that the digital twin collects if the work directory has none of a device
    count: int = 100
    size: tuple[int, int] = (640, 480)  # width and height of the twin's images (pixels)
    # numbers of gradient steps, one for each of the three models. None: each is trained for training.epochs epochs
    steps: tuple[int, int, int] | None = None
    # modalities that the models learn to predict when only some modalities are given: all of them, or only the given
    # ones (own, as in the paper)
    targets: Literal["all", "own"] = "all"
    # also train with the final pair as an input, so that the models learn that an object at rest stays at rest
    rest: bool = True
    shifts: int = 15  # number of shifted copies of each training trajectory
    largest_shift: int = 8  # largest shift of a copy (pixels). In images of 64 pixels, one pixel is 2.3 mm wide
    image_size: int = 64  # side of the images that are used and predicted (pixels). The paper uses 64
    held_out: float = 0.2  # share of the trajectories for validation. The paper uses 0.2
    seed: int = 0  # seed of the split into training and validation
    num_shown: int = 6  # number of validation trajectories in the figure


class Recorded(NamedTuple):
    """Recorded trajectories and images of the empty pad. All images are rectified to the view of `Sensor.camera`."""

    train: hardware.RecordedImages  # training trajectories
    validation: hardware.RecordedImages  # validation trajectories
    empty: dict[str, np.ndarray]  # image of the empty pad for each stream, uint8 (size, size, 3)
    identity: str  # checksum of the trajectories and the sensor file
    source: str  # description of the sensor, for titles


def check(config: Config) -> None:
    """Check the fields of the configuration.

    Raises:
        ValueError: A field is out of range.
    """
    if not 0 < config.held_out < 1:
        raise ValueError(f"held_out must be a share above 0 and below 1, got {config.held_out}")
    if config.shifts < 0 or not 0 <= config.largest_shift < config.image_size:
        raise ValueError(
            f"shifts must be >= 0 and largest_shift must be 0 to {config.image_size - 1} pixels, got shifts = "
            f"{config.shifts} and largest_shift = {config.largest_shift}"
        )
    if config.count < LEAST:
        raise ValueError(f"count must be >= {LEAST}, got {config.count}")
    if config.num_shown < 1:
        raise ValueError(f"num_shown must be >= 1, got {config.num_shown}")
    # This raises an error if no network exists for images of this size.
    training.paper_model(("visual",), training.Preprocessing((config.image_size, config.image_size)))


def read(config: Config, workdir: Path) -> Recorded:
    """Read the confirmed trajectories of a work directory, rectify the images, and hold out validation trajectories.

    A trajectory is confirmed if it has a `manifest.json`.

    Args:
        config: Configuration of the experiment.
        workdir: Work directory with the folder `dataset` and the sensor file.

    Raises:
        FileNotFoundError: The work directory has no session in `dataset`, or no sensor file.
        ValueError: There are too few trajectories. Or the content of the sensor file is invalid, names no background
            images (images of the empty pad), or does not fit the images. Or a background image is missing or damaged.
        OSError: A file cannot be read, or is damaged.
    """
    recordings = hardware.load_recordings(workdir / "dataset")
    device, sensor = sensor_file(workdir)
    if len(recordings) < LEAST:
        raise ValueError(
            f"the number of confirmed trajectories in {recordings.folder} must be >= {LEAST}, got {len(recordings)}: "
            "collect more, or confirm existing ones with `python -m experiments.real review --confirm NUMBER`"
        )
    size = (config.image_size, config.image_size)
    with Bar() as bar:
        found = hardware.recorded_images(
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
        hardware.RecordedImages(*(leaf[np.sort(rows)] for leaf in found)) for rows in (order[:cut], order[cut:])
    )
    source = "a digital twin" if is_twin(recordings) else f"the sensor {recordings.origin.camera}"
    return Recorded(train, validation, empty, identity(workdir, recordings), source)


def is_twin(recordings: hardware.Recordings) -> bool:
    """Return whether a digital twin made the trajectories.

    The serial number of a twin's LED controller begins with TWIN.
    """
    return recordings.origin.leds.startswith("TWIN")


def missing(config: Config, workdir: Path) -> int:
    """The number of trajectories that `experiments.real train` still has to collect with its own digital twin.

    The number is 0 if the trajectories in the work directory come from a device, or from a twin that
    `python -m experiments.twin` ran as a separate program.

    Raises:
        OSError: The manifest of the session is damaged.
    """
    if not (workdir / "dataset" / storage.MANIFEST).exists():
        return config.count
    recordings = hardware.load_recordings(workdir / "dataset")
    return max(config.count - len(recordings), 0) if recordings.origin.camera == twin.CAMERA else 0


def samples(config: Config, count: int) -> int:
    """The number of training samples from `count` trajectories, including the copies that `augmented` makes.

    `count` includes the trajectories that are held out for validation, but they yield no training samples.
    """
    return round((1 - config.held_out) * count) * (1 + config.shifts) * (2 if config.rest else 1)


def sensor_file(workdir: Path) -> tuple[hardware.Device, sts.Sensor]:
    """Read the sensor file of a work directory.

    Returns:
        The description of the device (such as the lens and the names of the background images) and the constants of the
        sensor.

    Raises:
        FileNotFoundError: There is no sensor file.
        ValueError: The sensor file is damaged, or names no background images.
    """
    path = workdir / "sensor.json"
    if not path.exists():
        raise FileNotFoundError(
            f"the sensor file {path} is missing: copy this file and the background images (images of the empty pad) "
            "into the work directory. `python -m experiments.commission` writes these files"
        )
    device = hardware.Device.load(path)
    if device.background_visual is None or device.background_tactile is None:
        raise ValueError(
            f"{path} names no background images (images of the empty pad), but they are needed to find contacts: run "
            "`python -m experiments.commission` again, and copy the sensor file and its images into the work directory"
        )
    return device, sts.Sensor.load(path)


def identity(workdir: Path, recordings: hardware.Recordings) -> str:
    """The checksum of the trajectories and the sensor file.

    The checksum also depends on the background images, because the sensor file contains their checksums.
    """
    return storage.digest({"dataset": recordings.identity, "sensor": storage.sha256(workdir / "sensor.json")})


def jobs(config: Config, data: Recorded) -> Iterator[stages.Job]:
    """Prepare the training of each of the three models of the paper's Table 2.

    Raises:
        ValueError: No tactile image that is an input of the training shows a contact.
    """
    size, blank = (config.image_size, config.image_size), data.empty["tactile"]
    preprocessing = training.touch_of_noisy_images(training.Preprocessing(size), data.train.tactile[:, 0], blank)
    visual, tactile = (augmented(config, getattr(data.train, name), data.empty[name]) for name in ("visual", "tactile"))
    for number, name in enumerate(NAMES):
        modalities = MODELS["paper"][name]
        arrays, own = training.image_arrays(visual, tactile, modalities, preprocessing, blank)
        if own.absent:
            raise ValueError(
                "none of the initial tactile images for training shows a contact: draw the newest images with "
                "`python -m experiments.real review --sheet review.png`, and compare them with the tactile background "
                "image that sensor.json names"
            )
        schedule = config.training
        if config.steps is not None:
            schedule = dataclasses.replace(schedule, steps=config.steps[number])
        yield stages.Job(name, schedule, training.paper_model(modalities, own), arrays, own, data.empty)


def augmented(config: Config, images: np.ndarray, empty: np.ndarray) -> np.ndarray:
    """Add shifted copies of image pairs, and copies in which the final image replaces the initial image.

    Each pair gets `config.shifts` shifted copies. If `config.rest` is True, every pair and every shifted copy is then
    added once more, with the final image in place of the initial image.

    Args:
        config: Configuration of the experiment.
        images: Pairs of an initial and a final image, all visual or all tactile, uint8 of shape (n, 2, size, size, 3).
        empty: Image of the empty pad, uint8 of shape (size, size, 3).

    Returns:
        The given pairs, followed by the copies, uint8 of shape (samples, 2, size, size, 3).
    """
    random, far = np.random.default_rng(config.seed), config.largest_shift
    parts = [images]
    for _ in range(config.shifts):
        parts.append(training.shifted(images, empty, random.integers(-far, far + 1, (len(images), 2))))
    if config.rest:
        parts += [part[:, [1, 1]] for part in parts]
    return np.concatenate(parts)


def train(config: Config, data: Recorded, folder: Path) -> None:
    """Train the three models of the paper's Table 2, and show the progress.

    Each model is stored in its own folder, such as `folder / "models" / "vae-visual"`.

    Raises:
        ValueError: No tactile image that is an input of the training shows a contact.
    """
    for job in jobs(config, data):
        with Bar() as bar:

            def show(done: int, total: int, record: dict[str, float], bar: Bar = bar, name: str = job.name) -> None:
                bar(f"train {name}", done, total, f"loss {record['loss']:.4g}" if record else "")

            stages.run(job, folder / "models" / job.name, config.targets, show)
