"""Measures the camera, the lights and the lens of a sensor, and writes its sensor file."""

import contextlib
import dataclasses
import datetime
import math
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import sts_jax as sts
from experiments.shared import backgrounds, boards, drawing
from experiments.shared.run import Folder
from sts_jax import hardware, storage

FRAME_SHARE = 0.9  # longest exposure as a share of the time between two frames
DARK = (0, 0, 0, 0)  # LED levels of the visual stream
V4L2_UNIT = 1e-4  # unit of the exposure of a Video4Linux device (s)


@dataclasses.dataclass(frozen=True)
class Config:
    """Options of the command line: devices, output folder, and whether to calibrate the lens or assume an ideal one."""

    camera: str | None = None  # path of the camera, such as /dev/v4l/by-id/..., or URL. None: list cameras and stop
    leds: str | None = None  # serial port of the LED controller, such as /dev/ttyACM0. None: list ports and stop
    out: Folder = Path("bench")  # folder for the sensor file
    width: int = 1640  # width of the camera's images (pixels)
    height: int = 1232  # height of the camera's images (pixels)
    fps: float | None = None  # frame rate (frames/s). None: the camera's own rate
    fourcc: str | None = None  # pixel format of the camera, such as MJPG. None: that of the driver
    # duty cycles of the four LED channels in the tactile stream, 0 (off) to 255 (always on)
    levels: tuple[int, int, int, int] = (255, 255, 255, 255)
    # folder with PNG pictures of the board, which replace live pictures. The board must lie on the pad in the picture
    # whose name is first in alphabetical order
    board_images: Path | None = None
    # take no pictures of the board, and assume a lens without error that has this field of view across the image's
    # diagonal (degrees)
    ideal_lens: float | None = None
    pictures: int = 15  # number of live pictures of the board
    every: float | None = None  # time to wait at each step (s). None: wait for the Enter key
    ruler: float = 100.0  # measured length of the printed 100 mm ruler (mm). It differs if the printer scales

    @property
    def board(self) -> hardware.Board:
        """Calibration board with the sizes that it has on the printed page: the nominal sizes times `ruler` / 100.

        `ruler` is the measured length of the ruler on the printed page (mm). It is 100 if the printer does not scale.
        """
        scale, nominal = self.ruler / 100, hardware.Board()
        return dataclasses.replace(nominal, square=scale * nominal.square, marker=scale * nominal.marker)


def check(config: Config) -> None:
    """Check the options before any work.

    Raises:
        ValueError: An option is out of range, or two contradict each other.
        OSError: The folder of pictures does not exist, or `out` cannot be written to.
    """
    hardware.CameraConfig(config.camera or 0, config.width, config.height, fps=config.fps, fourcc=config.fourcc)
    hardware.sts.checked_levels(config.levels)
    if config.board_images is not None and config.ideal_lens is not None:
        raise ValueError("--board-images and --ideal-lens exclude each other: leave out one of them")
    if config.ideal_lens is not None and not 0 < config.ideal_lens <= 360:
        raise ValueError(f"--ideal-lens is {config.ideal_lens:g}, but it must be above 0 and at most 360 degrees")
    if config.every is not None and not 0 <= config.every < math.inf:
        raise ValueError(f"--every is {config.every}, but it must be a finite time >= 0 (s)")
    if config.pictures < hardware.calibration.FEWEST_IMAGES:
        raise ValueError(f"--pictures is {config.pictures}, but it must be >= {hardware.calibration.FEWEST_IMAGES}")
    if not 80 <= config.ruler <= 120:
        raise ValueError(
            f"--ruler is {config.ruler:g} mm, but it must be 80 to 120 mm: measure the ruler on the printed page"
        )
    if config.board_images is not None and not config.board_images.is_dir():
        raise FileNotFoundError(
            f"--board-images is {config.board_images}, but this is not a folder: give a folder with pictures of the "
            "board"
        )
    drawing.make_folder(config.out)


@contextlib.contextmanager
def opened(config: Config) -> Iterator[tuple[hardware.OpenCVCamera, hardware.Leds]]:
    """Open the camera and the LED controller, and close them after the `with` block. The lights are off at first."""
    assert config.camera is not None
    assert config.leds is not None
    source = hardware.CameraConfig(
        config.camera, config.width, config.height, fps=config.fps, fourcc=config.fourcc, buffer=8
    )
    with hardware.Leds.connect(config.leds) as leds:
        say(f"LED controller {leds.serial_number}: {leds.board}, firmware {leds.firmware}")
        with hardware.OpenCVCamera(dataclasses.replace(source, lock=source.kind == "device")) as camera:
            while camera.statistics.rate is None:
                camera.async_read()
            say(f"camera {camera.source}: {config.width} x {config.height}, {camera.statistics.rate:.1f} frames/s")
            yield camera, leds


def expose(config: Config, camera: hardware.OpenCVCamera, leds: hardware.Leds) -> tuple[float, float] | None:
    """Choose the exposure of each stream. The lights are off afterwards.

    Args:
        config: Options of the command line.
        camera: Open camera.
        leds: Open LED controller.

    Returns:
        The exposures of the visual and the tactile stream in the driver's unit, or None if this program cannot set the
        camera's exposure.
    """
    now, rate = camera.locked.get("exposure"), camera.statistics.rate
    assert rate is not None
    settable = now is not None and now > 0 and camera.set_exposure(now) is not None
    chosen = []
    for stream, levels in (("visual", DARK), ("tactile", config.levels)):
        leds.set(levels)
        if settable:
            exposure, seen = hardware.choose_exposure(camera, longest=FRAME_SHARE / rate / V4L2_UNIT)
            chosen.append(exposure)
            words = f"{exposure:g} in the driver's unit"
        else:
            time.sleep(hardware.sts.LAG_S)
            seen = hardware.brightness(camera.read().image)
            words = "left to the server" if camera.config.kind == "stream" else "the driver does not let it be set"
        if seen >= hardware.sts.SATURATED:
            words += f". The image is SATURATED: {'lower --levels' if stream == 'tactile' else 'darken the room'}"
            words += "" if settable else ", or lower the exposure at the camera"
        say(f"exposure of the {stream} stream: brightness {seen:.0f} of 255, {words}")
    leds.set(DARK)
    return (chosen[0], chosen[1]) if settable else None


def ideal(config: Config, pinhole: sts.optics.Camera) -> hardware.Lens:
    """Make an ideal lens with the field of view of the option `--ideal-lens`, instead of a calibrated lens.

    An ideal lens is equidistant, and its optical axis is perpendicular to the pad and meets the centre of the pad.

    Raises:
        CalibrationError: The raw image of this lens does not contain the whole view of the sensor. The view is the part
            of the gel's outer face that rectified images show.
    """
    assert config.ideal_lens is not None
    lens = hardware.Lens.ideal(
        config.width,
        config.height,
        field_of_view=math.radians(config.ideal_lens),
        distance=float(pinhole.distance),
    )
    hardware.check_view(lens, pinhole)
    return lens


def fit(pictures: boards.Pictures, pinhole: sts.optics.Camera) -> hardware.Lens:
    """Calibrate the lens from pictures of the board, and print the error of each picture.

    Raises:
        CalibrationError: The pictures do not determine the lens, or they do not cover the part of the gel's outer face
            that rectified images show, or the camera does not see this whole part.
    """
    say(f"board: {len(pictures.names)} pictures in {pictures.folder}, {pictures.describe()}")
    calibration = pictures.fit(pinhole)
    for name, corners, error in zip(pictures.names, calibration.corners, calibration.errors, strict=True):
        say(f"  {name}: {corners} corners, " + ("not used" if error is None else f"error {error:.2f} pixels"))
    used = [error for error in calibration.errors if error is not None]
    needed = hardware.view_angle(calibration.lens, pinhole)
    x, y, z = (1e3 * c for c in calibration.lens.center)
    say(
        f"lens: reprojection errors {min(used):.2f} to {max(used):.2f} pixels, corners up to "
        f"{math.degrees(calibration.largest_angle):.1f} degrees, the view needs {math.degrees(needed):.1f}"
    )
    say(f"camera at x = {x:.1f}, y = {y:.1f}, z = {z:.1f} mm from the centre of the pad")
    return calibration.lens


def live(config: Config, sensor: hardware.STS, pinhole: sts.optics.Camera) -> hardware.Lens:
    """Take the missing pictures of the board, and calibrate the lens from all pictures in OUT/board.

    Raises:
        CalibrationError: The pictures do not determine the lens, or they do not cover the part of the gel's outer face
            that rectified images show, or the camera does not see this whole part. The message explains how to replace
            or add pictures.
        ValueError: A picture of an earlier run cannot be read, or its size differs from that of the camera's images.
            There is no keyboard, although `config.every` is None, which means that the user presses the Enter key
            before each picture.
    """
    folder, size = config.out / "board", (config.width, config.height)
    pictures = boards.Pictures.read(folder, config.board, size)
    if pictures.names:
        say(f"board: {len(pictures.names)} pictures of an earlier run are kept. To start again, delete {folder}")
    pictures = boards.take(pictures, sensor, config.pictures, config.every, say)
    try:
        return fit(pictures, pinhole)
    except hardware.CalibrationError as error:
        raise hardware.CalibrationError(
            f"{error} The pictures are kept in {folder}. If this message names bad pictures, delete them, and run the "
            "command again to take new ones. To add pictures, run the command again with --pictures larger than "
            f"{config.pictures}."
        ) from error


def check_folder(config: Config, camera: hardware.OpenCVCamera, leds: hardware.Leds) -> None:
    """Check that the folder does not contain the sensor file of other devices.

    Raises:
        ValueError: The sensor file in the folder names another camera or another LED controller.
    """
    try:
        there = hardware.Device.load(config.out)
    except (OSError, hardware.SensorFileError):
        return  # a missing or damaged file is written anew
    if (there.camera, there.leds) != (camera.source, leds.serial_number):
        raise ValueError(
            f"{config.out} contains the sensor file of the camera {there.camera} and the LED controller {there.leds}, "
            f"but the connected devices are {camera.source} and {leds.serial_number}: give another --out, or delete "
            "this sensor file"
        )


def claim_pictures(config: Config, camera: hardware.OpenCVCamera) -> None:
    """Reserve the folder OUT/board for pictures from one camera, of one size and of one printed calibration board.

    Raises:
        ValueError: The folder has pictures from another camera, of another size, or of a board with another value of
            `--ruler`, the measured length of the printed 100 mm ruler.
    """
    made = {"camera": camera.source, "width": config.width, "height": config.height, "ruler": config.ruler}
    storage.claim(config.out / "board" / "camera.json", made)


def commission(config: Config) -> None:
    """Measure the camera, the lights and the lens of a sensor, and write the sensor file.

    Args:
        config: Options of the command line, with `camera` and `leds`.

    Raises:
        ValueError: An option is out of range, or the folder belongs to other devices.
        CalibrationError: The lens cannot be calibrated from the pictures of the board.
        OSError: A file cannot be read or written.
    """
    check(config)
    simulated, size = sts.Sensor(), (config.width, config.height)
    pinhole = simulated.camera
    lens: hardware.Lens | None = None
    if config.ideal_lens is not None:
        lens = ideal(config, pinhole)
        say(f"lens: assumed without error, {config.ideal_lens:g} degrees across the diagonal, NOT calibrated")
    elif config.board_images is not None:
        lens = fit(boards.Pictures.read(config.board_images, config.board, size), pinhole)
    with opened(config) as (camera, leds):
        check_folder(config, camera, leds)
        if lens is None:
            claim_pictures(config, camera)
        boards.wait("Take everything off the pad, and leave the sensor untouched.", config.every)
        exposures = expose(config, camera, leds)
        with hardware.STS(camera=camera, leds=leds, levels=config.levels, exposures=exposures).connect() as sensor:
            settling = sensor.settling
            say(f"latency: light on {1e3 * settling.tactile_s:.0f} ms, off {1e3 * settling.visual_s:.0f} ms")
            sensor.wait_until_still()
            recorded = backgrounds.record(sensor)
            visual, tactile = recorded.noise
            say(
                f"background: mean of {backgrounds.PAIRS} pairs, noise {visual:.2f} (visual), {tactile:.2f} (tactile) "
                "of 255"
            )
            rate = camera.statistics.rate
            assert rate is not None
            nominal = 1 / (2 / rate + (settling.visual_s + settling.tactile_s) / 2)
            say(
                f"speed: {recorded.rate:.2f} pairs/s, {recorded.rate / nominal:.0%} of {nominal:.2f}, which are "
                "two frames and the mean latency a pair"
            )
            source: Literal["board", "ideal"] = "board" if config.ideal_lens is None else "ideal"
            if lens is None:
                lens = live(config, sensor, pinhole)
            device = hardware.Device(
                camera=camera.source,
                fps=config.fps or round(rate, 2),
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
                lens_from=source,
            )
    device.save(config.out, simulated, (recorded.visual, recorded.tactile))
    print(f"{config.out / hardware.sensor_file.NAME}: camera {device.camera}, controller {device.leds}, lens {source}")
    print(
        f"next, in Python: `with sts_jax.hardware.STS.from_file({str(config.out)!r}) as sensor: pair = sensor.read()`"
    )


def say(text: str) -> None:
    """Print one line without buffering."""
    print(text, flush=True)
