"""Measures the camera, the lights and the lens of a sensor, and writes its sensor file."""

import contextlib
import dataclasses
import datetime
import io
import math
import time
from collections.abc import Iterator
from pathlib import Path
from typing import cast

import numpy as np
from jaxtyping import UInt8
from PIL import Image, UnidentifiedImageError

import sts_jax as sts
from experiments.shared import drawing
from experiments.shared.terminal import say
from sts_jax import hardware, storage
from sts_jax.hardware.calibration import FEWEST_CORNERS, FEWEST_IMAGES, PARTS

FRAME_SHARE = 0.9  # longest exposure as a share of the time between two frames
DARK = (0, 0, 0, 0)  # LED levels of the visual stream
V4L2_UNIT = 1e-4  # unit of the exposure of a Video4Linux device (s)
PAIRS = 20  # number of pairs whose mean is a background
STILL = 1.0  # largest median movement of the corners between two frames of a board that is held still (pixels)
_FIRST = "000.png"  # picture of the board on the pad
_LAY = "Lay the board on the pad, print to the camera, edges on edges."
_HOLD = "Hold the board above the pad, tilted by 20 to 40 degrees, each time at another place."

Raw = UInt8[np.ndarray, "height width 3"]


@dataclasses.dataclass(frozen=True)
class Config:
    """Options of the command line: devices, output folder, and whether to calibrate the lens or assume an ideal one."""

    camera: str | None = None  # path of the camera, such as /dev/v4l/by-id/..., or URL. None: list cameras and stop
    leds: str | None = None  # serial port of the LED controller, such as /dev/ttyACM0. None: list ports and stop
    out: Path = Path("bench")  # folder for the sensor file
    width: int = 1640  # width of the camera's images (pixels)
    height: int = 1232  # height of the camera's images (pixels)
    fps: float | None = None  # frame rate (frames/s). None: the camera's own rate
    fourcc: str | None = None  # pixel format of the camera, such as MJPG. None: that of the driver
    # duty cycles of the four LED channels in the tactile stream, 0 (off) to 255 (always on)
    levels: tuple[int, int, int, int] = (255, 255, 255, 255)
    # take no pictures of the board, and assume a lens without error that has this field of view across the image's
    # diagonal (degrees)
    ideal_lens: float | None = None
    # number of pictures in OUT/board. Missing ones are taken. In the first by name, the board lies on the pad
    pictures: int = 15
    every: float | None = None  # time to wait at each step (s). None: wait for the Enter key
    ruler: float = 100.0  # measured length of the printed 100 mm ruler (mm). It differs if the printer scales
    print_board: Path | None = None  # write the board to this PDF or PNG file and stop

    @property
    def board(self) -> hardware.Board:
        """Calibration board with the sizes that it has on the printed page."""
        scale, nominal = self.ruler / 100, hardware.Board()
        return dataclasses.replace(nominal, square=scale * nominal.square, marker=scale * nominal.marker)

    @property
    def source(self) -> hardware.CameraConfig:
        """Configuration of the camera. Only settings of a local device are locked."""
        source = hardware.CameraConfig(
            self.camera or 0, self.width, self.height, fps=self.fps, fourcc=self.fourcc, buffer=8
        )
        return dataclasses.replace(source, lock=source.kind == "device")


def check(config: Config) -> None:
    """Check the options before any work."""
    _ = config.source
    hardware.leds.checked_levels(config.levels)
    if config.pictures < FEWEST_IMAGES:
        raise ValueError(f"--pictures must be >= {FEWEST_IMAGES}, got {config.pictures}")
    if not 80 <= config.ruler <= 120:
        raise ValueError(f"--ruler must be 80 to 120 mm, as measured on the printed page, got {config.ruler:g}")
    drawing.make_folder(config.out)


def commission(config: Config) -> None:
    """Measure the camera, the lights and the lens of a sensor, and write the sensor file."""
    check(config)
    simulated, size = sts.Sensor(), (config.width, config.height)
    lens = None
    if config.ideal_lens is not None:
        lens = ideal_lens(size, config.ideal_lens, simulated)
        hardware.check_view(lens, simulated.camera)
        say(f"lens: assumed without error, {config.ideal_lens:g} degrees across the diagonal, NOT calibrated")
    with storage.lock(config.out), opened(config) as (camera, leds):
        claim_folder(config, camera, leds)
        wait("Take everything off the pad, and leave the sensor untouched.", config.every)
        exposures = expose(config, camera, leds)
        with hardware.STS(camera=camera, leds=leds, levels=config.levels, exposures=exposures).connect() as sensor:
            settling = sensor.settling
            say(f"latency: light on {1e3 * settling.tactile_s:.0f} ms, off {1e3 * settling.visual_s:.0f} ms")
            sensor.wait_until_still()
            backgrounds = record_empty(sensor)
            say(f"background: mean of {PAIRS} pairs")
            if lens is None:
                lens = calibrate(config, sensor, simulated.camera)
            device = hardware.Device(
                camera=camera.source,
                fps=config.fps or round(camera.statistics.rate or 0.0, 2),
                leds=leds.serial_number,
                lens=lens,
                settle_on_s=settling.tactile_s,
                settle_off_s=settling.visual_s,
                levels=config.levels,
                commissioned=datetime.date.today().isoformat(),
                exposure_visual=exposures[0] if exposures else None,
                exposure_tactile=exposures[1] if exposures else None,
                fourcc=config.fourcc,
                white_balance=camera.locked.get("white_balance"),
                focus=camera.locked.get("focus"),
                lens_from="board" if config.ideal_lens is None else "ideal",
            )
    device.save(config.out, simulated, backgrounds)
    file = config.out / hardware.sensor_file.NAME
    print(f"{file}: camera {device.camera}, controller {device.leds}, lens {device.lens_from}")


def ideal_lens(size: tuple[int, int], field_of_view: float, sensor: sts.Sensor) -> hardware.Lens:
    """The equidistant lens of images (width, height), with a field of view across the diagonal (degrees)."""
    distance = float(sensor.camera.distance)
    return hardware.Lens.ideal(*size, field_of_view=math.radians(field_of_view), distance=distance)


def wait(text: str, every: float | None) -> None:
    """Show an instruction, and wait `every` seconds or for the Enter key."""
    if every is not None:
        say(f"{text} Continues in {every:g} s.")
        time.sleep(every)
        return
    try:
        input(f"{text} Then press Enter. ")
    except EOFError:
        raise ValueError("the Enter key cannot be read: give --every SECONDS") from None


@contextlib.contextmanager
def opened(config: Config) -> Iterator[tuple[hardware.OpenCVCamera, hardware.Leds]]:
    """Open the camera and the LED controller, whose lights are off."""
    assert config.leds is not None
    with hardware.Leds.connect(config.leds) as leds:
        say(f"LED controller {leds.serial_number}: {leds.controller.board}, firmware {leds.controller.firmware}")
        with hardware.OpenCVCamera(config.source) as camera:
            while camera.statistics.rate is None:
                camera.async_read()
            say(f"camera {camera.source}: {config.width} x {config.height}, {camera.statistics.rate:.1f} frames/s")
            yield camera, leds


def claim_folder(config: Config, camera: hardware.OpenCVCamera, leds: hardware.Leds) -> None:
    """Reserve the output folder for one camera and controller, one size of the images and one printed board."""
    devices = {"camera": camera.source, "leds": leds.serial_number}
    content = {**devices, "width": config.width, "height": config.height, "ruler": config.ruler}
    storage.claim(config.out / "board" / "camera.json", content)


def expose(config: Config, camera: hardware.OpenCVCamera, leds: hardware.Leds) -> tuple[float, float] | None:
    """Choose the exposures of both streams in the driver's unit, or None if the camera's exposure cannot be set."""
    now, rate = camera.locked.get("exposure"), camera.statistics.rate
    assert rate is not None
    settable = now is not None and now > 0 and camera.set_exposure(now) is not None
    chosen = []
    for stream, levels in (("visual", DARK), ("tactile", config.levels)):
        leds.set(levels)
        if settable:
            exposure, brightness = hardware.choose_exposure(camera, longest=FRAME_SHARE / rate / V4L2_UNIT)
            chosen.append(exposure)
            words = f"{exposure:g} in the driver's unit"
        else:
            time.sleep(hardware.sts.LAG_S)
            brightness = hardware.brightness(camera.read().image)
            words = "left to the server" if camera.config.kind == "stream" else "the driver does not let it be set"
        if brightness >= hardware.sts.SATURATED:
            words += f". The image is SATURATED: {'lower --levels' if stream == 'tactile' else 'darken the room'}"
            words += "" if settable else ", or lower the exposure at the camera"
        say(f"exposure of the {stream} stream: brightness {brightness:.0f} of 255, {words}")
    leds.set(DARK)
    return (chosen[0], chosen[1]) if settable else None


def record_empty(sensor: hardware.PairReader) -> tuple[Raw, Raw]:
    """The mean visual and the mean tactile image of `PAIRS` pairs of the empty pad."""
    sensor.read()
    first = sensor.read()
    sums = [shot.image.astype(np.float32) for shot in (first.visual, first.tactile)]
    for _ in range(PAIRS - 1):
        pair = sensor.read()
        sums = [total + shot.image for total, shot in zip(sums, (pair.visual, pair.tactile), strict=True)]
    visual, tactile = (np.round(total / PAIRS).astype(np.uint8) for total in sums)
    return visual, tactile


Corners = dict[str, hardware.FoundCorners]  # corners of the board by file name of the picture


def calibrate(config: Config, sensor: hardware.STS, pinhole: sts.optics.Camera) -> hardware.Lens:
    """Take the missing pictures of the board, and calibrate the lens from all pictures in OUT/board."""
    folder, corners = config.out / "board", Corners()
    for path in sorted(folder.glob("*.png")):
        corners[path.name] = read_board(config, path)
    if corners:
        say(f"board: {len(corners)} pictures of an earlier run are kept. To start again, delete {folder}")
    while len(corners) < config.pictures:
        take(config, sensor, corners)
    return fit(config, corners, pinhole)


def read_board(config: Config, path: Path) -> hardware.FoundCorners:
    """Find the board in a PNG file of the size of the camera's images."""
    try:
        with Image.open(path) as picture:
            image = np.asarray(picture.convert("RGB"))
    except (OSError, UnidentifiedImageError) as error:
        raise ValueError(f"{path} cannot be read ({error}): delete this picture, or take it again") from error
    if image.shape[1::-1] != (config.width, config.height):
        raise ValueError(
            f"{path} has {image.shape[1]} x {image.shape[0]} pixels, but --width is {config.width} and --height is "
            f"{config.height}: change these options, or delete the picture"
        )
    return hardware.find_board(image, config.board)


def take(config: Config, sensor: hardware.STS, corners: Corners) -> None:
    """Ask for a pose of the board, take a picture with the lights off, and keep it if the board is seen and still."""
    lay = _FIRST not in corners
    wait(_LAY if lay else _HOLD, config.every)
    next(sensor.stream(0.0))  # turns the lights off
    camera = cast(hardware.OpenCVCamera, sensor.camera)  # of `opened`
    first = hardware.find_board(camera.read().image, config.board)
    image = camera.read().image
    seen = hardware.find_board(image, config.board)
    _, before, after = np.intersect1d(first.numbers, seen.numbers, return_indices=True)
    moved = np.hypot(*(seen.pixels[after] - first.pixels[before]).T) if len(before) else np.array([np.inf])
    if len(seen.numbers) < FEWEST_CORNERS:
        say(f"  picture not kept: {len(seen.numbers)} corners of the board were found, but {FEWEST_CORNERS} are needed")
    elif np.median(moved) > STILL:
        say("  picture not kept: the board moved while the picture was taken: hold it still")
    else:
        last = max((int(Path(name).stem) for name in corners if Path(name).stem.isdecimal()), default=0)
        name, buffer = _FIRST if lay else f"{last + 1:03d}.png", io.BytesIO()
        Image.fromarray(image).save(buffer, "PNG", compress_level=3)
        storage.write_bytes(config.out / "board" / name, buffer.getvalue())
        corners[name] = seen
        words = coverage(config, corners)
        say(f"  {name}: {len(seen.numbers)} corners, {len(corners)} of {config.pictures}, {words}")


def coverage(config: Config, corners: Corners) -> str:
    """How many parts of the image at least one board has reached, and the names of the others."""
    covered = hardware.covered(list(corners.values()), (config.width, config.height))
    missing = ", ".join(part for part in PARTS if part not in covered)
    words = f"{len(covered)} of {len(PARTS)} parts of the image covered"
    return f"{words}, not yet {missing}" if missing else words


def fit(config: Config, corners: Corners, pinhole: sts.optics.Camera) -> hardware.Lens:
    """Calibrate the lens, check that lens and pictures cover the view of the sensor, and print the errors."""
    names, folder = sorted(corners), config.out / "board"
    say(f"board: {len(names)} pictures in {folder}, {coverage(config, corners)}")
    try:
        calibration = hardware.fit_lens([corners[name] for name in names], (config.width, config.height), config.board)
        hardware.check_view(calibration.lens, pinhole, calibration.largest_angle)
    except hardware.CalibrationError as error:
        raise hardware.CalibrationError(
            f"the calibration with the pictures in {folder} failed: {error} Images are numbered in order of names, "
            f"from 0 for {names[0]}. Delete bad ones, or raise --pictures to add some, and run the command again."
        ) from error
    for name, number, pixels in zip(names, calibration.corners, calibration.errors, strict=True):
        say(f"  {name}: {number} corners, " + ("not used" if pixels is None else f"error {pixels:.2f} pixels"))
    needed = hardware.view_angle(calibration.lens, pinhole)
    x, y, z = (1e3 * c for c in calibration.lens.center)
    say(
        f"lens: corners up to {math.degrees(calibration.largest_angle):.1f} degrees, the view needs "
        f"{math.degrees(needed):.1f}, camera at x = {x:.1f}, y = {y:.1f}, z = {z:.1f} mm from the centre of the pad"
    )
    return calibration.lens
