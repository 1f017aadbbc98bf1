"""`collect` and `review` of `experiments.real`: record trajectories with a person, and list, correct and draw them."""

import contextlib
import dataclasses
from collections.abc import Iterator
from pathlib import Path

import cv2
from PIL import Image, ImageDraw, ImageFont

from experiments.shared import drawing
from experiments.shared.device import Simulated, simulate
from experiments.shared.page import CollectPage
from experiments.shared.run import Folder
from experiments.shared.terminal import Terminal, say
from sts_jax import hardware, storage
from sts_jax.hardware import AutomaticPerson, EmptyPad, GuideConfig, Person, View

SHEET = 20  # number of trajectories, the newest ones, that `--sheet` draws by default
PANEL = 200  # width of an image on the sheet (pixels)


@dataclasses.dataclass(frozen=True)
class Collect:
    """Guide a person through trajectories, and save images of the held object, and of the object at rest."""

    workdir: Folder = Path("runs/real")  # work directory. The trajectories go to its folder `dataset`
    camera: str | None = None  # path or URL of the camera. None: the camera of the sensor file
    leds: str | None = None  # serial port of the LED controller. None: found by the serial number in the sensor file
    twin: bool = False  # use the digital twin instead of devices. Nobody needs to act, and there is no page
    seed: int = 0  # seed of the twin's object and trajectories
    sensor: Path | None = None  # sensor file of experiments.commission, or its folder
    # width and height of the images (pixels). None: those of the sensor file, 640 x 480 with --twin,
    # otherwise 1640 x 1232
    size: tuple[int, int] | None = None
    fourcc: str | None = None  # pixel format of the camera, such as MJPG. None: that of the sensor file or the driver
    lock: bool = True  # lock the exposure and the white balance of the camera
    # duty cycles of the four LED channels in the tactile stream, 0 (off) to 255 (always on). None: those of the sensor
    # file, or 255
    levels: tuple[int, int, int, int] | None = None
    # stop when the session has this number of confirmed trajectories, earlier ones included. None: stop at 100 with
    # the option --twin, and never without it
    count: int | None = None
    note: str = ""  # text that is stored with each trajectory, such as the object's name
    headless: bool = False  # show instructions in this terminal instead of on a page
    automatic: bool = False  # confirm every trajectory, and assume that the pad is empty at the start
    # address of the page. With 0.0.0.0, every computer of the network can watch and press the buttons
    host: str = "127.0.0.1"
    port: int = 8765  # TCP port of the page. 0 selects a free one
    guide: GuideConfig = dataclasses.field(default_factory=GuideConfig)  # thresholds and times of the guide
    debug: bool = False  # show the traceback of every error


@dataclasses.dataclass(frozen=True)
class Review:
    """List, discard, restore or confirm trajectories, check their files, or draw their images."""

    workdir: Folder = Path("runs/real")  # work directory. The trajectories are in its folder `dataset`
    discard: tuple[int, ...] = ()  # numbers of trajectories to move to the folder `discarded`
    restore: tuple[int, ...] = ()  # numbers of discarded trajectories to move back
    # numbers of trajectories to confirm. They have both pairs of images, but the session was interrupted before they
    # were confirmed
    confirm: tuple[int, ...] = ()
    note: str = ""  # text that is stored with the trajectories of --confirm
    check: bool = False  # read all images, and compare their checksums
    sheet: Path | None = None  # draw the newest confirmed trajectories into this picture
    numbers: tuple[int, ...] = ()  # numbers of trajectories that --sheet draws instead
    debug: bool = False  # show the traceback of every error


def collect(config: Collect) -> None:
    """Connect the sensor, and save trajectories until there are enough of them or the user stops the command."""
    if config.twin:
        simulate(of_twin(config))
        return
    sensor, empty = device(config)
    with person(config) as someone:
        say("connecting. Keep the pad empty, and do not move anything in view")
        with sensor:
            origin = hardware.Origin.of(sensor)
            with hardware.Session(config.workdir / "dataset", origin) as session:
                if config.sensor is not None:
                    keep(config.sensor, config.workdir)
                say(f"{session.folder} has {session.confirmed} confirmed trajectories. New ones are added")
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
                say(f"{session.confirmed} confirmed trajectories in {session.folder}")
            if isinstance(sensor.camera, hardware.OpenCVCamera):
                counts = sensor.camera.statistics
                say(
                    f"{counts.frames} frames arrived. {counts.skipped} of them were not read in time, and the camera "
                    f"lost {counts.dropped} others"
                )


def of_twin(config: Collect) -> Simulated:
    """Convert the options of `collect` to those of a collection with the twin, and refuse options for devices."""
    for name in ("camera", "leds", "sensor", "fourcc"):
        value = getattr(config, name)
        if value is not None:
            raise ValueError(f"--{name} is {value}, but no device is used with --twin: leave out --{name} or --twin")
    if not config.lock:
        raise ValueError("--no-lock has no effect on the digital twin (--twin): leave out --no-lock or --twin")
    given = {name: getattr(config, name) for name in ("count", "size", "levels")}
    options = {name: value for name, value in given.items() if value is not None}
    return Simulated(config.workdir, seed=config.seed, note=config.note, guide=config.guide, **options)


def device(config: Collect) -> tuple[hardware.STS, EmptyPad | None]:
    """Make the sensor that the options describe, not yet connected, and the look of its empty pad, if it is known."""
    if config.count is not None and config.count < 1:
        raise ValueError(f"--count must be >= 1, got {config.count}")
    if config.sensor is not None:
        return commissioned(config, config.sensor)
    if config.camera is None or config.leds is None:
        cameras, ports = hardware.find_cameras(), hardware.find_controllers()
        raise ValueError(
            f"{'--camera' if config.camera is None else '--leds'} is missing. Cameras found: "
            f"{', '.join(str(camera) for camera in cameras) or 'none'}. Serial ports found: "
            f"{', '.join(port.device for port in ports) or 'none'}. Give --camera and --leds, "
            "or a sensor file with --sensor"
        )
    width, height = config.size or (1640, 1232)
    camera = hardware.CameraConfig(config.camera, width, height, fourcc=config.fourcc, lock=config.lock)
    return hardware.STS(camera=camera, leds=config.leds, levels=config.levels or (255, 255, 255, 255)), None


def commissioned(config: Collect, file: Path) -> tuple[hardware.STS, EmptyPad | None]:
    """Make the sensor of a sensor file."""
    for name, value in (("size", config.size), ("levels", config.levels)):
        if value is not None:
            raise ValueError(
                f"--{name} is {value}, but the sensor file {file} determines this value: leave out --{name} or --sensor"
            )
    device = hardware.Device.load(file)
    camera = device.camera_config(config.camera)
    camera = dataclasses.replace(camera, lock=config.lock and camera.lock, fourcc=config.fourcc or camera.fourcc)
    backgrounds = device.backgrounds(file)
    empty = None if backgrounds is None else hardware.known_pad(*backgrounds)
    return hardware.STS.from_file(file, camera=camera, leds=config.leds), empty


def keep(file: Path, workdir: Path) -> None:
    """Copy a sensor file and its backgrounds into a work directory, or check that it has the same file already."""
    checksums = hardware.sensor_file.checksums
    if not (workdir / storage.MANIFEST).exists():  # the manifest is the last file of a copy
        hardware.copy_sensor(file, workdir)
    elif sorted(checksums(workdir).values()) != sorted(checksums(file).values()):
        raise ValueError(
            f"{workdir / hardware.sensor_file.NAME} differs from {file}, but one sensor file must describe all "
            "trajectories of a work directory: choose another --workdir"
        )


@contextlib.contextmanager
def person(config: Collect) -> Iterator[Person]:
    """The terminal or the page that shows instructions to a person and receives the person's actions."""
    if config.headless:
        terminal = Terminal(config.count, listens=not config.automatic)
        yield Automatic(terminal) if config.automatic else terminal
        return
    with contextlib.closing(CollectPage(config.host, config.port, count=config.count)) as page:
        page.announce("watch and press the buttons")
        yield Automatic(page) if config.automatic else page


class Automatic(AutomaticPerson):
    """Confirms every trajectory, and shows the views to another person, who can also act."""

    def __init__(self, other: Person):
        super().__init__()
        self._other = other

    def show(self, view: View) -> None:
        """Show a view to both."""
        super().show(view)
        self._other.show(view)

    def action(self) -> hardware.Action | None:
        """The action of the other person, or the automatic one."""
        return self._other.action() or super().action()


def review(config: Review) -> None:
    """Confirm, discard or restore trajectories, check files, draw images, or list trajectories."""
    folder = config.workdir / "dataset"
    if config.sheet is not None:
        drawing.check_picture(config.sheet)
    if config.restore or config.confirm or config.discard:
        with hardware.Session(folder) as session:
            for number in config.restore:
                session.restore(number)
            for number in config.confirm:
                session.confirm(number, config.note)
            for number in config.discard:
                session.discard(number)
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
    """Read all confirmed trajectories, and end with code 1 if one is damaged."""
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
    """Draw trajectories, the newest `SHEET` if there are no numbers, as rows: initial and final visual and tactile."""
    recordings = hardware.load_recordings(folder)
    if unknown := set(numbers) - set(recordings.numbers):
        raise ValueError(
            f"{folder} has no confirmed trajectories with the numbers {sorted(unknown)}: give other --numbers"
        )
    if not recordings.numbers:
        raise ValueError(f"no picture can be drawn, because {folder} has no confirmed trajectory: collect some first")
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
    drawing.write_picture(path, sheet)
