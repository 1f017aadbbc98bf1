"""Test of the distances that `experiments.gap` computes, on pairs of image sets with known differences.

    python -m benchmarks.gap                                                  # about ten minutes
    python -m benchmarks.gap --out benchmarks/results/gap/known.txt           # also write the table

A twin with its default imperfections (noise, vignetting, leaking light, JPEG, fisheye lens) takes the place of the real
sensor, and a "clean" twin with almost none that of the simulation. The first two rows of the table compare images that
differ by chance only, and each further row compares clean images with the same images after a known change. To compare
both recorded sessions:

    python -m experiments.gap --real runs/gap-twin/device --sensor runs/gap-twin --simulated runs/gap-twin/clean
"""

import dataclasses
import datetime
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import tyro

import sts_jax as sts
from experiments.shared import drawing, terminal
from experiments.shared.device import FIELD_OF_VIEW, TwinConfig, make_twin
from experiments.shared.terminal import Bar
from sts_jax import hardware, storage
from sts_jax.evaluation import gap
from sts_jax.hardware import twin
from sts_jax.hardware.twin import photometry

SIZE = (480, 640)  # height and width of the twin's frames
ON = (255, 255, 255, 255)
OFF = (0, 0, 0, 0)
SETTLE_S = 0.1  # time between a switch of the light and a frame
MOTION_RATE = 0.5  # rendered poses per second of the motion. Few, because only images at rest are read
LONGEST_S = 60.0  # longest time until the object is at rest
# No leaking light, no vignetting, no noise. The error of this JPEG quality is below one grey level
CLEAN = twin.Imperfections(leakage=0.0, vignetting=0.0, read_noise=0.0, full_well=1e12, jpeg_quality=100)


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of the command line."""

    workdir: Path = Path("runs/gap-twin")  # folder for both sessions and the sensor file
    trajectories: int = 40  # number of trajectories in each session
    resolution: tuple[int, int] = (240, 320)  # height and width at which images are compared (pixels)
    seed: int = 0  # seed of the object, the trajectories and the noise
    out: Path | None = None  # text file for the table (default: print only)


def make(seed: int, imperfections: twin.Imperfections, *, lens: bool) -> twin.Twin:
    """Make a twin on a virtual clock, with a photo camera on the pad."""
    field_of_view = FIELD_OF_VIEW if lens else None
    config = TwinConfig(
        resolution=SIZE, field_of_view=field_of_view, imperfections=imperfections, seed=seed, motion_rate=MOTION_RATE
    )
    return make_twin(config, prepare=False)


def read_pair(device: twin.Twin) -> tuple[hardware.Pair, tuple[float, ...]]:
    """Take a visual and a tactile image of an unmoving object, and return them with its pose from the twin's log."""
    shots, poses = [], []
    streams: tuple[tuple[Literal["visual", "tactile"], tuple[int, ...], float], ...] = (
        ("visual", OFF, 0.0),
        ("tactile", ON, 1.0),
    )
    for stream, levels, light in streams:
        before = device.set(levels)
        device.step(SETTLE_S)
        truth, image = device.capture()
        assert truth.lowest == truth.highest == light, f"the light changed during the {stream} exposure"
        assert truth.pose is not None
        after = device.ping()
        shots.append(hardware.Shot(image, stream, device.now_s, truth.index, 1, before, after.sent_s))
        poses.append(truth.pose)
    device.set(OFF)
    assert poses[0] == poses[1], "the object moved between the visual and the tactile image"
    return hardware.Pair(*shots), poses[0]


def release(device: twin.Twin) -> None:
    """Let the object go, and wait until it is at rest."""
    device.command("release")
    until_s = device.now_s + LONGEST_S
    while device.state.phase != twin.Phase.STILL:
        assert device.now_s < until_s, "the object does not come to rest"
        device.step(0.1)


def record(device: twin.Twin, folder: Path, count: int, note: str, bar: Bar) -> list[tuple[float, ...]]:
    """Record trajectories of a twin, and return the poses of all pairs."""
    poses = []
    with hardware.Session(folder, hardware.Origin(note, "TWIN", SIZE[1], SIZE[0], ON)) as session:
        if session.confirmed:
            raise ValueError(f"{folder} has {session.confirmed} trajectories already: delete it, or give --workdir")
        for done in range(count):
            bar(note, done, count)
            session.check_ready()
            number = session.begin()
            device.command("hold")
            for end in ("initial", "final"):
                if end == "final":
                    release(device)
                pair, pose = read_pair(device)
                session.save(number, end, pair)
                poses.append(pose)
            session.confirm(number, note)
        bar(note, count, count)
    return poses


def sessions(args: Args) -> hardware.Recordings:
    """Record both sessions, save the sensor file of `device`, and return the recordings of `clean`."""
    lens = hardware.Lens.ideal(SIZE[1], SIZE[0])
    poses = []
    with Bar() as bar:
        for name, imperfections in (("device", twin.Imperfections()), ("clean", CLEAN)):
            with make(args.seed, imperfections, lens=name == "device") as device:
                poses.append(record(device, args.workdir / name, args.trajectories, name, bar))
    assert poses[0] == poses[1], "the poses of the object differ between both sessions"
    hardware.Device(
        camera="http://127.0.0.1/camera",
        fps=30.0,
        leds="TWIN",
        lens=lens,
        settle_on_s=SETTLE_S,
        settle_off_s=SETTLE_S,
        levels=ON,
        commissioned=datetime.date.today().isoformat(),
        lens_from="ideal",
    ).save(args.workdir, sts.Sensor())
    return hardware.load_recordings(args.workdir / "clean")


@dataclasses.dataclass(frozen=True)
class Difference:
    """A change that the benchmark applies to clean images: imperfections of a camera, and optionally a fisheye lens."""

    name: str  # title of the row in the table
    imperfections: twin.Imperfections = CLEAN
    lens: bool = False  # apply the fisheye lens
    rectified: bool = True  # rectify the images of the lens


def levels(field: str, values: tuple[Any, ...]) -> list[Difference]:
    """Make a list of imperfect cameras, which differ from an almost perfect camera in a single imperfection."""
    return [Difference(f"{field} {value:g}", dataclasses.replace(CLEAN, **{field: value})) for value in values]


DIFFERENCES = (
    *levels("read_noise", (0.0015, 0.005, 0.02)),
    *levels("full_well", (8000.0, 2000.0, 500.0)),
    *levels("vignetting", (0.05, 0.25, 0.6)),
    *levels("leakage", (0.005, 0.05, 0.2)),
    *levels("jpeg_quality", (92, 70, 30)),
    Difference("lens of 160 degrees, rectified", lens=True),
    Difference("lens of 160 degrees, left as it is", lens=True, rectified=False),
    Difference("the twin's defaults, rectified", twin.Imperfections(), lens=True),
)


def changed(clean: gap.Streams, difference: Difference, resolution: tuple[int, int], seed: int) -> gap.Streams:
    """Change clean images as an imperfect camera would: add imperfections, distort and resize the images."""
    sensor, (height, width) = sts.Sensor(), clean.visual.shape[1:3]
    lens = hardware.Lens.ideal(width, height)
    blender = photometry.Blender(
        difference.imperfections,
        sensor=sensor,
        lens=lens if difference.lens else None,
        seed=seed,
    )
    streams: list[list[np.ndarray]] = [[], []]
    for visual, tactile in zip(clean.visual, clean.tactile, strict=True):
        ends = blender.ends(visual / np.float32(255), tactile / np.float32(255))
        for light, stream in enumerate(streams):
            image = blender.frame(ends, light)
            if (quality := difference.imperfections.jpeg_quality) < CLEAN.jpeg_quality:
                image = photometry.decode(photometry.encode(image, quality))
            if difference.lens and difference.rectified:
                stream.append(hardware.rectified(lens, sensor.camera, image, resolution))
            else:
                stream.append(reduced(image, resolution))
    return gap.Streams(np.stack(streams[0]), np.stack(streams[1]), clean.group)


def reduced(image: np.ndarray, resolution: tuple[int, int]) -> np.ndarray:
    """Resize an image to a smaller resolution (height, width) of the same aspect ratio."""
    return cv2.resize(image, resolution[::-1], interpolation=cv2.INTER_AREA)


def row(name: str, first: gap.Streams, second: gap.Streams, *, matched: bool) -> str:
    """Format a row of the table: the distances between two sets of images, for both streams."""
    words = [f"{name:36s}"]
    for stream in ("visual", "tactile"):
        one, two = getattr(first, stream), getattr(second, stream)
        error = "-" if not matched else f"{gap.pixel_errors(one, two, first.group).mae.value:.2f}"
        described = gap.features(one), gap.features(two), first.group, second.group
        energy, accuracy = gap.energy_distance(*described), gap.told_apart(*described)
        words.append(
            f"{error:>6s} {energy.value:7.3f} ({energy.p:.3f})  {accuracy.value:.2f} [{accuracy.low:.2f}, "
            f"{accuracy.high:.2f}]"
        )
    return "   ".join(words).rstrip()


def table(clean: gap.Streams, resolution: tuple[int, int]) -> Iterator[str]:
    """Yield the lines of the table of differences between clean images and changed copies of these images."""
    visual, tactile = (np.stack([reduced(image, resolution) for image in images]) for images in clean[:2])
    shown = gap.Streams(visual, tactile, clean.group)
    columns = f"{'MAE':>6s} {'energy':>7s} ({'p':^5s})  accuracy [95 %]  "
    yield f"{'':36s}   {'visual':39s}{'tactile'}"
    yield f"{'difference':36s}   {columns} {columns}".rstrip()
    middle = np.unique(clean.group)[len(np.unique(clean.group)) // 2]
    halves = [gap.Streams(*(leaf[part] for leaf in shown)) for part in (clean.group < middle, clean.group >= middle)]
    yield row("none: two halves of the clean session", halves[0], halves[1], matched=False)
    defaults = Difference("", twin.Imperfections(), lens=True)
    draws = [changed(clean, defaults, resolution, seed) for seed in (1, 2)]
    yield row("none: two draws of the twin's noise", draws[0], draws[1], matched=True)
    for difference in DIFFERENCES:
        yield row(difference.name, changed(clean, difference, resolution, 0), shown, matched=True)


def main(args: Args) -> None:
    """Record the image folders `device` and `clean`, then print the table of distances between sets of images."""
    height, width = args.resolution
    if args.trajectories < 2 * gap.FOLDS:  # two halves are compared
        raise ValueError(f"--trajectories must be >= {2 * gap.FOLDS}, got {args.trajectories}")
    if not math.isclose(width / height, SIZE[1] / SIZE[0]):
        raise ValueError(f"--resolution must have the aspect ratio {SIZE[0]}:{SIZE[1]}, got {height} x {width}")
    if args.out is not None:
        drawing.make_folder(args.out.parent)
    images = sessions(args).images()
    visual, tactile = (stream.reshape(-1, *SIZE, 3) for stream in (images.visual, images.tactile))
    clean = gap.Streams(visual, tactile, np.repeat(images.number, 2))
    lines = [f"{args.trajectories} trajectories, compared at {height} x {width} pixels, MAE of 255"]
    print(lines[0], flush=True)
    for line in table(clean, args.resolution):
        print(line, flush=True)
        lines.append(line)
    if args.out is not None:
        storage.write_bytes(args.out, ("\n".join(lines) + "\n").encode())


if __name__ == "__main__":
    sts.enable_compilation_cache()
    with terminal.on_one_line():
        main(tyro.cli(Args, description=__doc__))
