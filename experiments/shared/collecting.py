"""The sub-command `collect` of `experiments.real`: guide a person through trajectories, and save the trajectories."""

import contextlib
import dataclasses
from collections.abc import Iterator
from pathlib import Path

from experiments.shared import simulated
from experiments.shared.page import Page
from experiments.shared.run import Folder
from experiments.shared.terminal import Terminal, say, single_keys
from sts_jax import hardware, storage
from sts_jax.hardware import AutomaticPerson, EmptyPad, GuideConfig, Person, View


@dataclasses.dataclass(frozen=True)
class Collect:
    """Guide a person through trajectories, and save the images of each trajectory.

    A trajectory has a visual and a tactile image of the held object, and a visual and a tactile image of the object at
    rest.
    """

    workdir: Folder = Path("runs/real")  # work directory. The trajectories go to its folder `dataset`
    camera: str | None = None  # path or URL of the camera, or a video file. None: the camera of the sensor file
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


def device(config: Collect) -> tuple[hardware.STS, EmptyPad | None]:
    """Make the sensor that the options describe.

    Returns:
        The sensor, which is not connected yet, and the appearance of the empty pad. The appearance is computed from the
        background images of the sensor file, and is None if there are no background images.

    Raises:
        ValueError: An option is missing or out of range, or contradicts the sensor file.
        SensorFileError: The sensor file is damaged, or belongs to another camera.
        OSError: The sensor file does not exist.
    """
    if config.count is not None and config.count < 1:
        raise ValueError(f"--count must be >= 1, got {config.count}")
    if config.sensor is not None:
        return commissioned(config, config.sensor)
    if config.camera is None or config.leds is None:
        cameras, ports = hardware.find_sensors()
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
    """Make the sensor that a sensor file describes. See the function `device` for the return values and exceptions."""
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


def collect(config: Collect) -> None:
    """Connect the sensor, guide a person through trajectories, and save the trajectories.

    The collection ends when there are enough trajectories or the user stops the command.

    Raises:
        ValueError: An option is missing or out of range, or contradicts a file in the work directory. Or a sensor file
            is damaged.
        LockedError: Another process collects into the work directory.
        OSError: A file cannot be read or written, or a recorded trajectory is damaged.
        LedError, CameraError, LightError, NoContrastError: The sensor cannot be connected or read.
    """
    if config.twin:
        simulated.collect(of_twin(config))
        return
    sensor, empty = device(config)
    with person(config) as someone:
        say("connecting. Keep the pad empty, and do not move anything in view")
        with sensor:
            origin = hardware.Origin.of(sensor)
            with hardware.Session.open(config.workdir / "dataset", origin, settling=sensor.settling) as session:
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
                session.flush()
                say(f"{session.confirmed} confirmed trajectories in {session.folder}")
            counts = sensor.camera.statistics
            say(
                f"{counts.frames} frames arrived. {counts.skipped} of them were not read in time, and the camera lost "
                f"{counts.dropped} others"
            )


def of_twin(config: Collect) -> simulated.Simulated:
    """Convert the options of `collect` to the options of a collection with the digital twin.

    Raises:
        ValueError: An option is out of range, or an option for a real device is given.
    """
    devices = {"camera": config.camera, "leds": config.leds, "sensor": config.sensor, "fourcc": config.fourcc}
    for name, value in devices.items():
        if value is not None:
            raise ValueError(f"--{name} is {value}, but no device is used with --twin: leave out --{name} or --twin")
    if not config.lock:
        raise ValueError("--no-lock has no effect on the digital twin (--twin): leave out --no-lock or --twin")
    default = simulated.Simulated(config.workdir)
    return simulated.Simulated(
        config.workdir,
        count=default.count if config.count is None else config.count,
        size=default.size if config.size is None else config.size,
        levels=default.levels if config.levels is None else config.levels,
        seed=config.seed,
        note=config.note,
        guide=config.guide,
    )


def keep(file: Path, workdir: Path) -> None:
    """Copy a sensor file and its backgrounds into a work directory.

    If the work directory already contains a sensor file, nothing is copied, and both sensor files must have the same
    content.

    Args:
        file: Path of the sensor file or of its folder.
        workdir: Work directory.

    Raises:
        ValueError: The work directory already contains a sensor file with another content.
        SensorFileError: A sensor file or a background image is damaged.
        OSError: The sensor file does not exist, or a file cannot be written.
    """
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
    """Make the page or terminal that shows instructions to a person and receives the person's actions.

    The page is closed at the end of the `with` block.

    Raises:
        OSError: The address of the page cannot be used.
        ValueError: The terminal cannot be read key by key.
    """
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
    """A `Person` that confirms every trajectory automatically and prints the instructions in the terminal."""

    def __init__(self, count: int | None):
        super().__init__()
        self._terminal = Terminal(count, keys=False)

    def show(self, view: View) -> None:
        """Print `view.problem`, or `view.instruction` if there is no problem.

        Nothing is printed if the instruction, the problem and the number of the trajectory are the same as in the
        previous call.
        """
        super().show(view)
        self._terminal.show(view)


class AutomaticPage(AutomaticPerson):
    """The page for a collection in which every trajectory is confirmed automatically. Its buttons can still be used."""

    def __init__(self, page: Page):
        super().__init__()
        self._page = page

    def show(self, view: View) -> None:
        """Update all open pages with the images and the instruction in `view`."""
        super().show(view)
        self._page.show(view)

    def action(self) -> hardware.Action | None:
        """Return the action of the button that was pressed last, or the automatic action if no button was pressed.

        The automatic action is `Action.CONFIRM` in the stage `REVIEW`, in which a recorded trajectory is confirmed or
        discarded. In all other stages, it is None.
        """
        return self._page.action() or super().action()
