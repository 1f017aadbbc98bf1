"""Measures the camera, the lights and the lens of a sensor, and writes its sensor file."""

import contextlib
import dataclasses
import datetime
import io
import math
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image, UnidentifiedImageError

import sts_jax as sts
from experiments.shared import drawing
from experiments.shared.run import Folder
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
    print_board: Path | None = None  # write the board to this PDF or PNG file and stop

    @property
    def board(self) -> hardware.Board:
        """Calibration board with the sizes that it has on the printed page."""
        scale, nominal = self.ruler / 100, hardware.Board()
        return dataclasses.replace(nominal, square=scale * nominal.square, marker=scale * nominal.marker)


def check(config: Config) -> None:
    """Check the options before any work."""
    hardware.CameraConfig(config.camera or 0, config.width, config.height, fps=config.fps, fourcc=config.fourcc)
    hardware.sts.checked_levels(config.levels)
    if config.board_images is not None and config.ideal_lens is not None:
        raise ValueError("--board-images and --ideal-lens exclude each other: leave out one of them")
    if config.ideal_lens is not None and not 0 < config.ideal_lens <= 360:
        raise ValueError(f"--ideal-lens is {config.ideal_lens:g}, but it must be above 0 and at most 360 degrees")
    if config.every is not None and not 0 <= config.every < math.inf:
        raise ValueError(f"--every is {config.every}, but it must be a finite time >= 0 (s)")
    if config.pictures < FEWEST_IMAGES:
        raise ValueError(f"--pictures is {config.pictures}, but it must be >= {FEWEST_IMAGES}")
    if not 80 <= config.ruler <= 120:
        raise ValueError(
            f"--ruler is {config.ruler:g} mm, but it must be 80 to 120 mm: measure the ruler on the printed page"
        )
    if config.board_images is not None and not config.board_images.is_dir():
        raise FileNotFoundError(f"--board-images is {config.board_images}, but this is not a folder of pictures")
    drawing.make_folder(config.out)


def commission(config: Config) -> None:
    """Measure the camera, the lights and the lens of a sensor, and write the sensor file."""
    check(config)
    simulated, size = sts.Sensor(), (config.width, config.height)
    lens: hardware.Lens | None = None
    if config.ideal_lens is not None:
        angle, distance = math.radians(config.ideal_lens), float(simulated.camera.distance)
        lens = hardware.Lens.ideal(*size, field_of_view=angle, distance=distance)
        hardware.check_view(lens, simulated.camera)
        say(f"lens: assumed without error, {config.ideal_lens:g} degrees across the diagonal, NOT calibrated")
    elif config.board_images is not None:
        lens = Pictures.read(config.board_images, config.board, size).fit(simulated.camera)
    with opened(config) as (camera, leds):
        check_folder(config, camera, leds)
        if lens is None:
            claim_pictures(config, camera)
        wait("Take everything off the pad, and leave the sensor untouched.", config.every)
        exposures = expose(config, camera, leds)
        with hardware.STS(camera=camera, leds=leds, levels=config.levels, exposures=exposures).connect() as sensor:
            settling = sensor.settling
            say(f"latency: light on {1e3 * settling.tactile_s:.0f} ms, off {1e3 * settling.visual_s:.0f} ms")
            sensor.wait_until_still()
            empty = record_empty(sensor)
            say(
                f"background: mean of {PAIRS} pairs, noise {empty.noise[0]:.2f} (visual), {empty.noise[1]:.2f} "
                "(tactile) of 255"
            )
            rate = camera.statistics.rate
            assert rate is not None
            nominal = 1 / (2 / rate + (settling.visual_s + settling.tactile_s) / 2)
            say(
                f"speed: {empty.rate:.2f} pairs/s, {empty.rate / nominal:.0%} of {nominal:.2f}, which are "
                "two frames and the mean latency a pair"
            )
            if lens is None:
                lens = calibrate(config, sensor, simulated.camera)
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
                lens_from="board" if config.ideal_lens is None else "ideal",
            )
    device.save(config.out, simulated, (empty.visual, empty.tactile))
    file = config.out / hardware.sensor_file.NAME
    print(f"{file}: camera {device.camera}, controller {device.leds}, lens {device.lens_from}")
    print(
        f"next, in Python: `with sts_jax.hardware.STS.from_file({str(config.out)!r}) as sensor: pair = sensor.read()`"
    )


def say(text: str) -> None:
    """Print one line without buffering."""
    print(text, flush=True)


def wait(text: str, every: float | None) -> str:
    """Show an instruction, wait `every` seconds or for the Enter key, and return what was typed, in lower case."""
    if every is not None:
        say(f"{text} Continues in {every:g} s.")
        time.sleep(every)
        return ""
    try:
        return input(f"{text} Then press Enter. ").strip().lower()
    except EOFError:
        raise ValueError(
            "the Enter key cannot be read: give --every SECONDS, and --board-images FOLDER or --ideal-lens DEGREES to "
            "run without live pictures"
        ) from None


@contextlib.contextmanager
def opened(config: Config) -> Iterator[tuple[hardware.OpenCVCamera, hardware.Leds]]:
    """Open the camera and the LED controller, whose lights are off."""
    assert config.camera is not None
    assert config.leds is not None
    source = hardware.CameraConfig(
        config.camera, config.width, config.height, fps=config.fps, fourcc=config.fourcc, buffer=8
    )
    with hardware.Leds.connect(config.leds) as leds:
        say(f"LED controller {leds.serial_number}: {leds.controller.board}, firmware {leds.controller.firmware}")
        with hardware.OpenCVCamera(dataclasses.replace(source, lock=source.kind == "device")) as camera:
            while camera.statistics.rate is None:
                camera.async_read()
            say(f"camera {camera.source}: {config.width} x {config.height}, {camera.statistics.rate:.1f} frames/s")
            yield camera, leds


def check_folder(config: Config, camera: hardware.OpenCVCamera, leds: hardware.Leds) -> None:
    """Check that the folder does not contain the sensor file of other devices."""
    try:
        there = hardware.Device.load(config.out)
    except (OSError, ValueError):
        return  # a missing or damaged file is written anew
    if (there.camera, there.leds) != (camera.source, leds.serial_number):
        raise ValueError(
            f"{config.out} is for the camera {there.camera} and the LED controller {there.leds}, but the connected "
            f"devices are {camera.source} and {leds.serial_number}: give another --out"
        )


def claim_pictures(config: Config, camera: hardware.OpenCVCamera) -> None:
    """Reserve the folder OUT/board for pictures from one camera, of one size and of one printed board."""
    content = {"camera": camera.source, "width": config.width, "height": config.height, "ruler": config.ruler}
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


@dataclasses.dataclass(frozen=True, eq=False)
class Empty:
    """The mean visual image and the mean tactile image of the empty pad."""

    visual: UInt8[np.ndarray, "height width 3"]  # mean image without light, RGB
    tactile: UInt8[np.ndarray, "height width 3"]  # mean image with light, RGB
    noise: tuple[float, float]  # standard deviation of one pixel over time in the visual and the tactile stream, of 255
    rate: float  # pairs per second, measured with `time.monotonic`


def record_empty(sensor: hardware.PairReader) -> Empty:
    """Take `PAIRS` pairs of images of the empty pad, and compute the mean image of each stream."""
    sums: dict[str, np.ndarray] = {}
    squares: dict[str, np.ndarray] = {}
    taken_s = 0.0
    sensor.read()
    for _ in range(PAIRS):
        start = time.monotonic()
        pair = sensor.read()
        taken_s += time.monotonic() - start
        for shot in (pair.visual, pair.tactile):
            image = shot.image.astype(np.uint32)
            sums[shot.stream] = sums.get(shot.stream, 0) + image
            squares[shot.stream] = squares.get(shot.stream, 0) + image**2
    means = {stream: total / PAIRS for stream, total in sums.items()}
    variances = {stream: (squares[stream] / PAIRS - means[stream] ** 2) * PAIRS / (PAIRS - 1) for stream in means}
    visual, tactile = (np.round(means[stream]).astype(np.uint8) for stream in ("visual", "tactile"))
    noise = {stream: math.sqrt(max(float(variance.mean()), 0.0)) for stream, variance in variances.items()}
    return Empty(visual, tactile, (noise["visual"], noise["tactile"]), PAIRS / taken_s)


def calibrate(config: Config, sensor: hardware.STS, pinhole: sts.optics.Camera) -> hardware.Lens:
    """Take the missing pictures of the board, and calibrate the lens from all pictures in OUT/board."""
    folder = config.out / "board"
    pictures = Pictures.read(folder, config.board, (config.width, config.height))
    if pictures.corners:
        say(f"board: {len(pictures.corners)} pictures of an earlier run are kept. To start again, delete {folder}")
    take(pictures, sensor, config.pictures, config.every)
    try:
        return pictures.fit(pinhole)
    except hardware.CalibrationError as error:
        raise hardware.CalibrationError(
            f"{error} The pictures are kept in {folder}. Delete bad ones, or raise --pictures above {config.pictures} "
            "to add some, and run the command again."
        ) from error


@dataclasses.dataclass
class Pictures:
    """The pictures of the calibration board in a folder. In the first one by name, the board lies on the pad."""

    folder: Path  # folder of the PNG files
    board: hardware.Board  # geometry of the printed board
    size: tuple[int, int]  # width and height of the pictures (pixels)
    corners: dict[str, hardware.FoundCorners]  # corners of the board by file name

    @classmethod
    def read(cls, folder: Path, board: hardware.Board, size: tuple[int, int]) -> "Pictures":
        """Read all PNG files of a folder, which must have the size (width, height), and find the board in each."""
        pictures = cls(folder, board, size, {})
        for path in sorted(folder.glob("*.png")):
            try:
                with Image.open(path) as picture:
                    image = np.asarray(picture.convert("RGB"))
            except (OSError, UnidentifiedImageError) as error:
                raise ValueError(f"{path} cannot be read ({error}): delete this picture, or take it again") from error
            if image.shape[1::-1] != size:
                raise ValueError(
                    f"{path} has {image.shape[1]} x {image.shape[0]} pixels, but --width is {size[0]} and --height is "
                    f"{size[1]}: change these options, or take the picture again"
                )
            pictures.corners[path.name] = hardware.find_board(image, board)
        return pictures

    def describe(self) -> str:
        """How many parts of the image at least one board has reached, and the names of the others."""
        covered = hardware.covered(list(self.corners.values()), self.size)
        missing = ", ".join(part for part in PARTS if part not in covered)
        return f"{len(covered)} of {len(PARTS)} parts of the image covered" + (
            f", not yet {missing}" if missing else ""
        )

    def fit(self, pinhole: sts.optics.Camera) -> hardware.Lens:
        """Calibrate the lens, check that lens and pictures cover the view of the sensor, and print the errors."""
        names = sorted(self.corners)
        say(f"board: {len(names)} pictures in {self.folder}, {self.describe()}")
        try:
            calibration = hardware.fit_lens([self.corners[name] for name in names], self.size, self.board)
            hardware.check_view(calibration.lens, pinhole, calibration.largest_angle)
        except hardware.CalibrationError as error:
            numbers = f" Image 0 is {names[0]}. Images are numbered in order of names." if names else ""
            raise hardware.CalibrationError(
                f"the calibration with the pictures in {self.folder} failed: {error}{numbers}"
            ) from error
        for name, corners, pixels in zip(names, calibration.corners, calibration.errors, strict=True):
            say(f"  {name}: {corners} corners, " + ("not used" if pixels is None else f"error {pixels:.2f} pixels"))
        used = [error for error in calibration.errors if error is not None]
        needed = hardware.view_angle(calibration.lens, pinhole)
        x, y, z = (1e3 * c for c in calibration.lens.center)
        say(
            f"lens: reprojection errors {min(used):.2f} to {max(used):.2f} pixels, corners up to "
            f"{math.degrees(calibration.largest_angle):.1f} degrees, the view needs {math.degrees(needed):.1f}"
        )
        say(f"camera at x = {x:.1f}, y = {y:.1f}, z = {z:.1f} mm from the centre of the pad")
        return calibration.lens


def take(pictures: Pictures, sensor: hardware.STS, number: int, every: float | None) -> None:
    """Take pictures, the one on the pad first, until the board was found in `number` of them, or `done` was typed."""
    kept = pictures.corners
    while len(kept) < number:
        enough, lay = len(kept) >= FEWEST_IMAGES, _FIRST not in kept
        done = " Type `done` if there are enough pictures." if enough and every is None else ""
        typed = wait(_LAY if lay else _HOLD + done, every)
        if typed == "done" and enough and not lay:
            break
        image, corners, problem = _picture(sensor, pictures.board)
        if problem:
            say(f"  picture not kept: {problem}")
            continue
        last = max((int(Path(name).stem) for name in kept if Path(name).stem.isdecimal()), default=0)
        name = _FIRST if lay else f"{last + 1:03d}.png"
        buffer = io.BytesIO()
        Image.fromarray(image).save(buffer, "PNG", compress_level=3)
        storage.write_bytes(pictures.folder / name, buffer.getvalue())
        kept[name] = corners
        say(f"  {name}: {len(corners.numbers)} corners, {len(kept)} of {number}, {pictures.describe()}")


def _picture(
    sensor: hardware.STS, board: hardware.Board
) -> tuple[UInt8[np.ndarray, "height width 3"], hardware.FoundCorners, str]:
    """Take a picture with the lights off. Returns it, its corners, and why it cannot be used (or an empty text)."""
    next(sensor.stream(0.0))  # turns the lights off
    first = hardware.find_board(sensor.camera.read().image, board)
    image = sensor.camera.read().image
    corners = hardware.find_board(image, board)
    if len(corners.numbers) < FEWEST_CORNERS:
        number = len(corners.numbers)
        return image, corners, f"{number} corners of the board were found, but {FEWEST_CORNERS} are needed"
    _, before, after = np.intersect1d(first.numbers, corners.numbers, return_indices=True)
    moved = np.hypot(*(corners.pixels[after] - first.pixels[before]).T) if len(before) else np.array([np.inf])
    if np.median(moved) > STILL:
        return image, corners, "the board moved while the picture was taken: hold it still"
    return image, corners, ""
