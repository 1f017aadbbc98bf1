"""Collect trajectories of the real sensor, and review them.

    python -m experiments.real collect --camera /dev/v4l/by-id/... --leds /dev/ttyACM0    # opens a page for the browser
    python -m experiments.real collect --sensor runs/commission/sensor.json --leds /dev/ttyACM0 --count 500
    python -m experiments.real collect --camera http://127.0.0.1:8080/video --leds PATH --headless --automatic
    python -m experiments.real review                       # lists the trajectories
    python -m experiments.real review --sheet review.png    # draws the last 20
    python -m experiments.real review --discard 3 17

`collect` guides a person through trajectories: place the object in an unstable pose, hold it, release it, wait until it
rests. The initial and the final pair of images are saved as they happen, raw and uncropped, into `WORKDIR/dataset`. An
interruption loses nothing that was confirmed. The same command continues with the next number.
"""

import contextlib
import dataclasses
import signal
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import cv2
import tyro
from PIL import Image, ImageDraw, ImageFont

from experiments.shared import errors, output
from experiments.shared.command import Folder
from experiments.shared.page import Page
from experiments.shared.progress import say
from experiments.shared.terminal import Terminal, single_keys
from sts_jax import hardware
from sts_jax.hardware import AutomaticPerson, EmptyPad, GuideConfig, Person, Settling, View

SHEET = 20  # newest trajectories that a sheet shows
PANEL = 200  # pixels, width of an image on a sheet


@dataclasses.dataclass(frozen=True)
class Collect:
    """Guide a person through trajectories, and save their initial and final pairs."""

    workdir: Folder = Path("runs/real")  # the trajectories go to its folder `dataset`
    camera: str | None = None  # device, URL or video file (default: that of the sensor file)
    leds: str | None = None  # serial port of the LED controller
    sensor: Path | None = None  # sensor file of the commissioning, with its camera, levels, settling and backgrounds
    size: tuple[int, int] | None = None  # width and height, pixels (default: of the sensor file, or 1640 x 1232)
    fourcc: str | None = None  # pixel format of a device, such as MJPG
    lock: bool = True  # lock exposure and white balance
    levels: tuple[int, int, int, int] | None = None  # of the LED channels (default: of the sensor file, or 255)
    count: int | None = None  # stop when the session has as many confirmed trajectories (default: never)
    note: str = ""  # stored with each trajectory, such as the object's name
    headless: bool = False  # in this terminal, without a page
    automatic: bool = False  # confirm every trajectory, and take the pad to be empty at the start
    host: str = "127.0.0.1"  # address of the page. 0.0.0.0: every computer of the network can watch and press buttons
    port: int = 8765  # of the page, 0: a free one
    guide: GuideConfig = dataclasses.field(default_factory=GuideConfig)
    debug: bool = False  # show the traceback of every error


@dataclasses.dataclass(frozen=True)
class Review:
    """List the trajectories, discard, restore or confirm some, check the files, or draw a sheet."""

    workdir: Folder = Path("runs/real")
    discard: tuple[int, ...] = ()  # move these to the folder `discarded`
    restore: tuple[int, ...] = ()  # move these back
    confirm: tuple[int, ...] = ()  # confirm these, which were complete when the session was interrupted
    note: str = ""  # stored with those that are confirmed
    check: bool = False  # read all images and compare their checksums
    sheet: Path | None = None  # draw the newest confirmed trajectories into this picture
    numbers: tuple[int, ...] = ()  # draw these instead
    debug: bool = False  # show the traceback of every error


def device(config: Collect) -> tuple[hardware.STS, hardware.Device | None, EmptyPad | None]:
    """The sensor of the options, not connected yet, and the device and empty pad of the sensor file.

    Raises:
        ValueError: An option is missing or out of range.
        SensorFileError: The sensor file is damaged.
        OSError: The sensor file cannot be read.
    """
    found = None if config.sensor is None else hardware.Device.load(config.sensor)
    source = config.camera or (None if found is None else found.camera)
    if source is None or config.leds is None:
        cameras, ports = hardware.find_sensors()
        raise ValueError(
            f"{'--camera' if source is None else '--leds'} is missing. Cameras found: "
            f"{', '.join(str(camera) for camera in cameras) or 'none'}. Serial ports found: "
            f"{', '.join(port.device for port in ports) or 'none'}"
        )
    if config.count is not None and config.count < 1:
        raise ValueError(f"count must be >= 1, got {config.count}")
    width, height = config.size or ((1640, 1232) if found is None else (found.width, found.height))
    levels = config.levels or ((255, 255, 255, 255) if found is None else found.levels)
    camera = hardware.CameraConfig(
        source,
        width,
        height,
        fourcc=config.fourcc,
        lock=config.lock,
        exposure=None if found is None else found.exposure_visual,
    )
    empty, settling = None, None
    if found is not None and found.background_visual is not None and found.background_tactile is not None:
        assert config.sensor is not None
        visual, tactile = (found.background(config.sensor, stream) for stream in ("visual", "tactile"))
        empty = hardware.known_pad(visual, tactile)
        settling = Settling(found.settle_off_s, found.settle_on_s)
    return hardware.STS(camera=camera, leds=config.leds, levels=levels, settling=settling), found, empty


def collect(config: Collect) -> None:
    """Connect, guide, save."""
    sensor, found, empty = device(config)
    with person(config) as someone:
        say("connecting. Keep the pad empty and still")
        with sensor:
            if found is not None:
                found.check_identity(camera=config.camera, leds=sensor.leds.serial_number)
            origin = hardware.Origin.of(sensor)
            with hardware.Session.open(config.workdir / "dataset", origin, settling=sensor.settling) as session:
                say(f"{session.confirmed} trajectories in {session.folder}, which is continued")
                try:
                    hardware.collect(
                        sensor,
                        session,
                        someone,
                        config=config.guide,
                        empty=empty,
                        trusted=config.automatic,
                        count=config.count,
                        note=config.note,
                    )
                except KeyboardInterrupt:
                    say("stopped")
                session.flush()
                say(f"{session.confirmed} confirmed trajectories in {session.folder}")
            counts = sensor.camera.statistics
            say(
                f"{counts.frames} frames, of which the computer missed {counts.skipped} and the camera {counts.dropped}"
            )


@contextlib.contextmanager
def person(config: Collect) -> Iterator[Person]:
    """The one who sees and acts: a page, a terminal, or nobody."""
    if config.headless:
        with single_keys():
            yield AutomaticTerminal(config.count) if config.automatic else Terminal(config.count)
        return
    page = Page(config.host, config.port, count=config.count)
    reach = "only this computer can open it"
    if not page.is_local:
        reach = "EVERY computer that reaches this address can watch and press the buttons"
    say(f"open {page.url} in a browser. The page listens on {config.host}, so {reach}")
    try:
        yield AutomaticPage(page) if config.automatic else page
    finally:
        page.close()


class AutomaticTerminal(AutomaticPerson):
    """Confirms every trajectory, and prints the instructions."""

    def __init__(self, count: int | None):
        super().__init__()
        self._terminal = Terminal(count, keys=False)

    def show(self, view: View) -> None:
        """Print the view if it has changed."""
        super().show(view)
        self._terminal.show(view)


class AutomaticPage(AutomaticPerson):
    """Confirms every trajectory, and shows the page, whose buttons work too."""

    def __init__(self, page: Page):
        super().__init__()
        self._page = page

    def show(self, view: View) -> None:
        """Show the view."""
        super().show(view)
        self._page.show(view)

    def action(self) -> hardware.Action | None:
        """The action of a button, or else the automatic one."""
        return self._page.action() or super().action()


def review(config: Review) -> None:
    """Apply the changes, then check, draw or list."""
    folder = config.workdir / "dataset"
    if config.sheet is not None:
        output.check_picture(config.sheet)
    for number in config.restore:
        hardware.restore_recording(folder, number)
    for number in config.confirm:
        hardware.confirm_recording(folder, number, config.note)
    for number in config.discard:
        hardware.discard_recording(folder, number)
    if config.check:
        check(folder)
    if config.sheet is not None:
        draw(folder, config.numbers, config.sheet)
        print(config.sheet)
    if config.check or config.sheet is not None:
        return
    entries = hardware.list_recordings(folder)
    for entry in entries:
        print(f"{entry.number:5d}  {entry.standing:11s}  {entry.taken or '-':29s}  {entry.note}".rstrip())
    print(f"{sum(entry.standing == 'confirmed' for entry in entries)} confirmed of {len(entries)} in {folder}")


def check(folder: Path) -> None:
    """Read all confirmed trajectories.

    Raises:
        SystemExit: Some are damaged. All of them are named.
    """
    recordings, damaged = hardware.load_recordings(folder), 0
    for index in range(len(recordings)):
        try:
            recordings[index]
        except OSError as error:
            say(str(error))
            damaged += 1
    print(f"{len(recordings) - damaged} of {len(recordings)} confirmed trajectories are undamaged in {folder}")
    if damaged:
        raise SystemExit(1)


def draw(folder: Path, numbers: tuple[int, ...], path: Path) -> None:
    """Draw trajectories as rows of four images: initial visual and tactile, final visual and tactile.

    Raises:
        ValueError: There is no confirmed trajectory, or one of the numbers has none.
    """
    recordings = hardware.load_recordings(folder)
    if unknown := set(numbers) - set(recordings.numbers):
        raise ValueError(f"{folder} has no confirmed trajectories {sorted(unknown)}: give others with --numbers")
    if not recordings.numbers:
        raise ValueError(f"{folder} has no confirmed trajectory to draw: collect some first")
    chosen = numbers or recordings.numbers[-SHEET:]
    rows = []
    for number in chosen:
        trajectory = recordings[recordings.numbers.index(number)]
        shots = [shot for pair in (trajectory.initial, trajectory.final) for shot in (pair.visual, pair.tactile)]
        height = round(PANEL * shots[0].image.shape[0] / shots[0].image.shape[1])
        rows.append([cv2.resize(shot.image, (PANEL, height), interpolation=cv2.INTER_AREA) for shot in shots])
    height, margin, head = rows[0][0].shape[0], 60, 24
    sheet = Image.new("RGB", (margin + 4 * (PANEL + 4), head + len(rows) * (height + 4)), "white")
    pen, font = ImageDraw.Draw(sheet), ImageFont.load_default(size=14)
    for column, title in enumerate(("initial, visual", "initial, tactile", "final, visual", "final, tactile")):
        pen.text((margin + column * (PANEL + 4), 4), title, fill="black", font=font)
    for row, (number, images) in enumerate(zip(chosen, rows, strict=True)):
        pen.text((6, head + row * (height + 4) + height // 2 - 8), str(number), fill="black", font=font)
        for column, image in enumerate(images):
            sheet.paste(Image.fromarray(image), (margin + column * (PANEL + 4), head + row * (height + 4)))
    sheet.save(path)


def main(config: Collect | Review) -> None:
    """Run a sub-command, with errors on one line."""
    with errors.on_one_line(debug=config.debug):
        try:
            if isinstance(config, Collect):
                collect(config)
            else:
                review(config)
        except (hardware.CameraError, hardware.LightError, hardware.NoContrastError) as error:
            if config.debug:
                raise
            raise SystemExit(f"error: {error}") from None
        except KeyboardInterrupt:
            raise SystemExit("stopped") from None


def _terminated(*_: object) -> None:
    raise KeyboardInterrupt  # so that what was taken is written, as after Ctrl+C


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, _terminated)
    warnings.formatwarning = lambda message, *_, **__: f"note: {message}\n"
    main(
        tyro.cli(
            Annotated[Collect, tyro.conf.subcommand("collect")] | Annotated[Review, tyro.conf.subcommand("review")],
            description=__doc__,
        )
    )
