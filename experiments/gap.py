"""Measure how much real and simulated images of the same object differ, and draw the images side by side.

    python -m experiments.gap --real runs/real/dataset --sensor bench --match none \\
        --simulated runs/twin/dataset --simulated-sensor runs/twin
    python -m experiments.gap --real runs/real/dataset --sensor bench --simulated runs/released/dataset --match none

`--simulated` is a session of the twin, or the dataset of an experiment that was run with `--collection.no-crop`. By
default, a real and a simulated trajectory with the same number must show the same object in the same poses. Give
`--match none` if the two folders show the same object in different poses. The measures are described in
`docs/hardware/gap.md`. The text and a figure of the images go to the folder `--out`. The classifier needs scikit-learn
and threadpoolctl (`pip install scikit-learn threadpoolctl`).
"""

import dataclasses
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import tyro

import sts_jax as sts
from experiments.shared import drawing, terminal
from sts_jax import dataset, evaluation, hardware, storage
from sts_jax.evaluation import figures, gap

STREAMS = ("visual", "tactile")


@dataclasses.dataclass(frozen=True)
class Config:
    """Options of the command line: the folders of real and simulated images, and how the images are compared."""

    real: Path  # folder of the real images: a session of `experiments.real collect`
    simulated: Path  # folder of the simulated images: a session, or the dataset of an experiment
    sensor: Path | None = None  # sensor file of the real images. None: the images are rectified already
    simulated_sensor: Path | None = None  # sensor file of a simulated session. None: its images are rectified already
    # how the trajectories of both folders correspond. number: those of equal number show the same object in the same
    # poses, and the others are ignored. none: both folders show the same object and scenario, but the poses in the
    # two folders differ
    match: Literal["number", "none"] = "number"
    # height and width to which the images are reduced before the comparison (pixels). None: those of the dataset,
    # or 240 x 320 for two sessions
    resolution: tuple[int, int] | None = None
    names: tuple[str, str] = ("real", "simulated")  # titles of the real and the simulated images in the figure
    rows: int = 4  # number of trajectories in the figure, with two rows each
    out: Path = Path("runs/gap")  # folder for gap.txt and gap.png
    debug: bool = False  # show the traceback of every error


def streams(visual: np.ndarray, tactile: np.ndarray, numbers: np.ndarray) -> gap.Streams:
    """The initial and the final image of numbered trajectories, from images (n, 2, height, width, 3)."""
    visual, tactile = (leaf.reshape(-1, *leaf.shape[2:]) for leaf in (visual, tactile))
    return gap.Streams(visual, tactile, np.repeat(numbers, 2))


def session(folder: Path, sensor: Path | None, resolution: tuple[int, int]) -> gap.Streams:
    """Read the images of a session, and rectify them with the lens of a sensor file, unless there is none."""
    recordings = hardware.load_recordings(folder)
    if sensor is None:
        return streams(*recordings.images(lambda image: centred(image, resolution)))
    device = hardware.Device.load(sensor)
    device.check_identity(leds=recordings.origin.leds)
    pinhole = sts.Sensor.load(hardware.sensor_file.sensor_file(sensor)).camera
    return streams(*recordings.images(lambda image: hardware.rectified(device.lens, pinhole, image, resolution)))


def simulated_dataset(folder: Path, resolution: tuple[int, int] | None) -> gap.Streams:
    """Read the first and the last frame of each rendered trajectory of a dataset."""
    data = dataset.load(folder)
    if data.collection["crop"]:
        raise ValueError(f"{folder} has images cropped to the object: collect it again with --collection.no-crop")
    size = tuple(data.collection["resolution"])
    if resolution is not None and resolution != size:
        raise ValueError(
            f"--resolution is {resolution}, but the images of {folder} have the size {size}: leave out --resolution"
        )
    pairs = data.pairs(data.rendered())
    return streams(pairs.visual, pairs.tactile, pairs.trajectory)


def centred(image: np.ndarray, resolution: tuple[int, int]) -> np.ndarray:
    """Crop a rectified image at its centre to the aspect ratio of `resolution`, and resize it by averaging pixels."""
    (height, width), (rows, columns) = image.shape[:2], resolution
    scale = min(height / rows, width / columns)
    tall, wide = round(rows * scale), round(columns * scale)
    top, left = (height - tall) // 2, (width - wide) // 2
    part = image[top : top + tall, left : left + wide]
    return cv2.resize(part, (columns, rows), interpolation=cv2.INTER_AREA)


def chosen(images: gap.Streams, numbers: np.ndarray) -> gap.Streams:
    """Select the images whose trajectory number is in `numbers`."""
    rows = np.isin(images.group, numbers)
    return gap.Streams(*(leaf[rows] for leaf in images))


def check_size(size: tuple[int, int]) -> None:
    """Refuse images that are too small to be compared."""
    if min(size) < gap.LEAST_SIDE:
        raise ValueError(f"--resolution must be at least {gap.LEAST_SIDE} x {gap.LEAST_SIDE}, got {size}")


def load(config: Config) -> tuple[gap.Streams, gap.Streams]:
    """Read both sides. With `--match number`, they have the same trajectory numbers, otherwise none in common."""
    if config.resolution is not None:
        check_size(config.resolution)
    if (config.simulated / "collection.json").exists():
        if config.match == "number" or config.simulated_sensor is not None:
            raise ValueError(
                f"{config.simulated} is a dataset, whose images are rectified and whose numbers match no real ones: "
                "give --match none, and leave out --simulated-sensor"
            )
        simulated = simulated_dataset(config.simulated, config.resolution)
    else:
        simulated = session(config.simulated, config.simulated_sensor, config.resolution or (240, 320))
    height, width = simulated.visual.shape[1:3]
    check_size((height, width))
    real = session(config.real, config.sensor, (height, width))
    if config.match == "none":
        return real, simulated._replace(group=simulated.group + real.group.max() + 1)
    common = np.intersect1d(real.group, simulated.group)
    if not len(common):
        raise ValueError(f"{config.real} and {config.simulated} have no trajectory number in common: give --match none")
    return chosen(real, common), chosen(simulated, common)


def report(config: Config, real: gap.Streams, simulated: gap.Streams) -> str:
    """The text that the command prints: the sources of the images, and a table of the measured differences."""
    height, width = real.visual.shape[1:3]
    sides = (config.real, config.sensor, real), (config.simulated, config.simulated_sensor, simulated)
    lines = [
        f"{folder}{f' with the lens of {sensor}' if sensor else ''}: {len(np.unique(images.group))} trajectories"
        for folder, sensor, images in sides
    ]
    matching = "matched by number" if config.match == "number" else "not matched"
    lines += [f"{matching}, compared at {height} x {width}", "", f"{'':42s}{'visual':26s}tactile"]
    columns = [measured(real, simulated, stream, matched=config.match == "number") for stream in STREAMS]
    for name in columns[0]:
        lines.append(f"{name:42s}{''.join(f'{column[name]:26s}' for column in columns)}".rstrip())
    return "\n".join([*lines, "", "In brackets: 95 % interval over trajectories (bootstrap)."])


def measured(real: gap.Streams, simulated: gap.Streams, stream: str, *, matched: bool) -> dict[str, str]:
    """Compare the real with the simulated images of one stream: formatted values by the names of the metrics."""

    def written(estimate: gap.Estimate, digits: int) -> str:
        return evaluation.metrics.written(*estimate, digits)

    first, second = getattr(real, stream), getattr(simulated, stream)
    rows = {}
    if matched:
        errors = gap.pixel_errors(first, second, real.group)
        # A shift by two images pairs each image with the same end of another trajectory.
        other = gap.pixel_errors(first, np.roll(second, 2, axis=0), real.group)
        rows = {
            "mean absolute error (of 255)": written(errors.mae, 2),
            "root mean squared error (of 255)": written(errors.rmse, 2),
            "PSNR (dB)": written(errors.psnr, 1),
            "SSIM": written(errors.ssim, 3),
            "  same, for another trajectory: MAE": written(other.mae, 2),
            "  same, for another trajectory: SSIM": written(other.ssim, 3),
        }
    one, two = gap.features(first), gap.features(second)
    energy = gap.energy_distance(one, two, real.group, simulated.group)
    rows["energy distance (0: equal, 1: far apart)"] = f"{energy.value:.3f} (p = {energy.p:.3f})"
    rows["accuracy of a classifier (0.5: chance)"] = written(gap.told_apart(one, two, real.group, simulated.group), 3)
    return rows


def draw(config: Config, real: gap.Streams, simulated: gap.Streams) -> None:
    """Draw the real and the simulated images of the first `config.rows` trajectories into `gap.png`."""
    numbers, others = (np.unique(side.group)[: config.rows] for side in (real, simulated))
    shown, matched = min(len(numbers), len(others)), config.match == "number"
    heads = [f"#{number}" if matched else "draw" for number in numbers[:shown]]
    labels = [f"{head}\n{end}" for head in heads for end in ("initial", "final")]
    title = "the same object in the same poses" if matched else "draws of both sides, in other poses"
    first, second = chosen(real, numbers[:shown]), chosen(simulated, others[:shown])
    path = config.out / "gap.png"
    figures.side_by_side(path, first, second, labels, matched=matched, title=title, names=config.names)


def main(config: Config) -> None:
    """Read the real and the simulated images, print how much they differ, and draw the figure."""
    if config.rows < 1:
        raise ValueError(f"--rows must be >= 1, got {config.rows}")
    gap.check_installed()
    drawing.make_folder(config.out)
    real, simulated = load(config)
    common = " in common" if config.match == "number" else ""
    if (number := min(len(np.unique(side.group)) for side in (real, simulated))) < gap.FOLDS:
        raise ValueError(
            f"{config.real} and {config.simulated} must have at least {gap.FOLDS} trajectories{common}, got {number}"
        )
    text = report(config, real, simulated)
    print(text)
    storage.write_bytes(config.out / "gap.txt", f"{text}\n".encode())
    draw(config, real, simulated)


if __name__ == "__main__":
    arguments = tyro.cli(Config, description=__doc__)
    with terminal.on_one_line(debug=arguments.debug):
        main(arguments)
