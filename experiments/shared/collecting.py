"""`collect` and `review` of `experiments.real`: record trajectories with a person, and list, correct and draw them."""

import contextlib
import dataclasses
import datetime
import time
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

import sts_jax as sts
from experiments.shared import commissioning, drawing, interrupts
from experiments.shared.device import FIELD_OF_VIEW, TwinConfig, TwinHand, make_twin
from experiments.shared.page import CollectPage
from experiments.shared.terminal import SEEDS, SIDES, Bar, Terminal, check_numbers, say
from sts_jax import hardware, storage
from sts_jax.hardware import Action, AutomaticPerson, EmptyPad, GuideConfig, Person, Stage, View, twin

SHEET = 20  # number of trajectories, the newest ones, that `--sheet` draws by default
PANEL = 200  # width of an image on the sheet (pixels)
TWIN_COUNT = 100  # number of confirmed trajectories at which a collection with the twin ends by default
TWIN_SIZE = 640, 480  # default width and height of the twin's images (pixels)
TWIN_RATE = 15.0  # frame rate of a collecting twin (frames/s). The guide needs few frames, and each frame costs time
# Rendered poses per second of a moving object of a collecting twin. They must follow each other fast enough that the
# guide does not take the object for one at rest.
MOTION_RATE = 4.0
_PATIENCE_S = 60.0  # longest wait of the twin's hand for a new instruction (s on the twin's clock)
_UNSEEN_S = 3.0  # time without a visible contact after which the next held pose is tried (s)
_UNSEEN = 10  # held poses in a row without a visible contact after which the hand gives up
_UNMOVED_S = 3.0  # time without motion after a release after which the object counts as resting where it was (s)
_WAIT_S = 0.1  # time of the computer's clock between two attempts while the session cannot be written (s)


@dataclasses.dataclass(frozen=True)
class Collect:
    """Guide a person through trajectories, and save images of the held object, and of the object at rest."""

    workdir: Path = Path("runs/real")  # work directory. The trajectories go to its folder `dataset`
    sensor: Path | None = None  # sensor file of experiments.commission, or its folder
    camera: str | None = None  # path or URL of the camera. None: the camera of the sensor file
    leds: str | None = None  # serial port of the LED controller. None: found by the serial number in the sensor file
    twin: bool = False  # use the digital twin instead of devices. Nobody needs to act, and there is no page
    seed: int = 0  # seed of the twin's object and trajectories
    size: tuple[int, int] = TWIN_SIZE  # width and height of the twin's images (pixels)
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

    workdir: Path = Path("runs/real")  # work directory. The trajectories are in its folder `dataset`
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


# sensor, session, person, and the look of the empty pad, if it is known
Setup = tuple[hardware.PairReader, hardware.Session, Person, EmptyPad | None]


def collect(config: Collect) -> None:
    """Connect the sensor, and save trajectories until there are enough of them or the user stops the command.

    A twin has a fixed sequence of trajectories for each seed, which an interrupted collection continues.
    """
    dataset, count = config.workdir / "dataset", config.count or (TWIN_COUNT if config.twin else None)
    check_options(config)
    there = (dataset / storage.MANIFEST).exists() and len(hardware.load_recordings(dataset))
    if count is not None and there >= count:
        say(f"{dataset} has {count} trajectories already")
        return
    with contextlib.ExitStack() as stack:
        stack.enter_context(storage.lock(config.workdir))
        prepare = of_twin if config.twin else of_device
        sensor, session, someone, empty = prepare(config, dataset, stack)
        stack.enter_context(interrupts.in_order())
        before, begun_s = session.confirmed, time.monotonic()
        say(f"{dataset} has {before} confirmed trajectories. New ones are added")
        trusted, guide, note = config.automatic or config.twin, config.guide, config.note
        try:
            hardware.collect(
                sensor, session, someone, config=guide, empty=empty, trusted=trusted, count=count, note=note
            )
        finally:
            number, seconds = session.confirmed - before, time.monotonic() - begun_s
            say(f"{number} new trajectories in {seconds:.1f} s, {seconds / max(number, 1):.2f} s each")


def check_options(config: Collect) -> None:
    """Refuse options that exclude each other."""
    check_numbers(config, count=(1, 1_000_000), seed=SEEDS, size=SIDES)
    given = [f"--{name}" for name in ("sensor", "camera", "leds") if getattr(config, name) is not None]
    if config.twin and given:
        raise ValueError(f"{given[0]} and --twin exclude each other: leave out one of them")
    if not config.twin and config.sensor is None:
        raise ValueError("--sensor is missing: give the sensor file of `experiments.commission`, or --twin")
    if not config.twin and config.size != TWIN_SIZE:
        raise ValueError(f"--size is {config.size}, but the sensor file {config.sensor} determines the size")


def of_device(config: Collect, dataset: Path, stack: contextlib.ExitStack) -> Setup:
    """Connect the sensor of a sensor file, and show a page or the terminal to a person."""
    assert config.sensor is not None
    sensor = hardware.STS.from_file(config.sensor, camera=config.camera, leds=config.leds)
    backgrounds = hardware.Device.load(config.sensor).backgrounds(config.sensor)
    someone: Person
    if config.headless:
        someone = Terminal(config.count, listens=not config.automatic)
    else:
        page = CollectPage(config.host, config.port, count=config.count)
        page.hand = TwinHand.of_camera(sensor.camera.source)
        someone = stack.enter_context(contextlib.closing(page))
    say("connecting. Keep the pad empty, and do not move anything in view")
    stack.enter_context(sensor)
    session = stack.enter_context(hardware.Session(dataset, hardware.Origin.of(sensor)))
    keep(config.sensor, config.workdir)
    empty = None if backgrounds is None else hardware.known_pad(*backgrounds)
    return sensor, session, Automatic(someone) if config.automatic else someone, empty


def of_twin(config: Collect, dataset: Path, stack: contextlib.ExitStack) -> Setup:
    """Start a twin on its virtual clock, and a hand that moves its object."""
    device = stack.enter_context(started(config, hardware.next_recording(dataset)))
    sensor, empty = commissioned(config, device)
    session = stack.enter_context(hardware.Session(dataset, sensor.origin))
    hand = Hand(device, session, stack.enter_context(Bar()), config.count or TWIN_COUNT)
    return sensor, session, hand, empty


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


class Automatic(AutomaticPerson):
    """Confirms every trajectory, and shows the views to another person, who can also act."""

    def __init__(self, other: Person):
        super().__init__()
        self._other = other

    def show(self, view: View) -> None:
        """Show a view to both."""
        super().show(view)
        self._other.show(view)

    def action(self) -> Action | None:
        """The action of the other person, or the automatic one."""
        return self._other.action() or super().action()


class Hand(AutomaticPerson):
    """Replaces the person: moves the object of a twin as `hardware.collect` instructs, and shows the progress.

    If no contact is seen within 3 s, the hand tries the first pose of the next trajectory, and the number stays unused
    in the session, so that a trajectory has the same number in session and scene.
    """

    def __init__(
        self, device: twin.Twin, session: hardware.Session, bar: Bar, count: int, *, patience_s: float = _PATIENCE_S
    ):
        super().__init__()
        self._device, self._session, self._bar, self._count = device, session, bar, count
        self._patience_s = patience_s
        self._seen: Stage | None = None  # stage of the last view
        self._since_s = self._now_s = 0.0  # begin of that stage, and time of the last view (s)
        self._placed = False  # True if the object is on the pad
        self._held_s: float | None = None  # time since which the object is held without a problem of the session (s)
        self._unseen = 0  # held poses in a row without a visible contact
        self._problem: str | None = None

    def show(self, view: View) -> None:
        """Move the object as the newest instruction requires. Raises an error if the collection does not go on."""
        super().show(view)
        self._bar("collect", view.confirmed, self._count)
        self._now_s = self._device.now_s
        if view.stage is not self._seen or view.problem is not None:
            self._seen, self._since_s = view.stage, self._now_s
        if view.problem is not None:
            self._held_s = None if self._held_s is None else self._now_s
            if self._problem is None:
                say(view.problem)
            time.sleep(_WAIT_S)
        self._problem = view.problem
        if view.stage is Stage.CLEAR and self._placed:
            self._device.command("clear")
            self._placed, self._held_s = False, None
        elif view.stage is Stage.PLACE:
            self._place()
        elif view.stage is Stage.RELEASE and self._held_s is not None:
            self._device.command("release")
            self._held_s, self._unseen = None, 0
        if self._now_s - self._since_s > self._patience_s or self._unseen == _UNSEEN:
            raise ValueError(
                f"no progress after `{view.instruction}` for {self._now_s - self._since_s:.1f} s and {self._unseen} "
                f"held poses without visible contact (contact: {view.contact}, still: {view.still}): change GuideConfig"
            )

    def action(self) -> Action | None:
        """Confirm a trajectory that waits for its review, or a release after which nothing has moved for 3 s."""
        if self._seen is Stage.RELEASE and self._now_s - self._since_s > _UNMOVED_S:
            return Action.CONFIRM
        return super().action()

    def _place(self) -> None:
        """Hold the object in the next pose, unless the guide may still see the contact of the current one."""
        if self._held_s is not None:
            if self._now_s - self._held_s <= _UNSEEN_S:
                return
            self._unseen += 1
            self._session.begin()
        self._placed, self._held_s = True, self._now_s
        self._device.command("hold")


def started(config: Collect, first: int) -> twin.Twin:
    """Make a twin that begins with the trajectory number `first`."""
    options = TwinConfig(resolution=config.size[::-1], rate=TWIN_RATE, motion_rate=MOTION_RATE, seed=config.seed)
    return make_twin(options, first=first, prepare=False)


def commissioned(config: Collect, device: twin.Twin) -> tuple[twin.VirtualSensor, EmptyPad]:
    """Connect to a twin with an empty pad, and write its sensor file if the work directory has none."""
    file, simulated = config.workdir / hardware.sensor_file.NAME, sts.Sensor()
    if file.exists():
        there = hardware.Device.load(file)
        if there.camera == twin.CAMERA and there.leds != device.serial_number:
            seed = there.leds.removeprefix("TWIN")
            raise ValueError(
                f"--seed is {config.seed}, but {config.workdir} is of a twin with another seed: give --seed {seed}, or "
                "another --workdir"
            )
        there.check_identity(camera=twin.CAMERA, leds=device.serial_number)
        if (there.lens.width, there.lens.height) != config.size:
            size = f"{there.lens.width} x {there.lens.height}"
            raise ValueError(f"--size is {config.size}, but {file} is for images of {size} pixels")
    sensor = twin.VirtualSensor(device)
    backgrounds = commissioning.record_empty(sensor)
    if not file.exists():
        config.workdir.mkdir(parents=True, exist_ok=True)
        hardware.Device(
            camera=twin.CAMERA,
            fps=device.rate,
            leds=device.serial_number,
            lens=commissioning.ideal_lens(config.size, FIELD_OF_VIEW, simulated),
            settle_on_s=sensor.settling.tactile_s,
            settle_off_s=sensor.settling.visual_s,
            levels=sensor.origin.levels,
            commissioned=datetime.date.today().isoformat(),
            lens_from="ideal",
        ).save(config.workdir, simulated, backgrounds)
    return sensor, hardware.known_pad(*backgrounds)


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
        raise ValueError(f"{folder} has no confirmed trajectories {sorted(unknown)}: give other --numbers")
    if not recordings.numbers:
        raise ValueError(f"{folder} has no confirmed trajectory: collect some first")
    rows = []
    for number in numbers or recordings.numbers[-SHEET:]:
        trajectory = recordings[recordings.numbers.index(number)]
        shots = [shot for pair in (trajectory.initial, trajectory.final) for shot in (pair.visual, pair.tactile)]
        height = round(PANEL * shots[0].image.shape[0] / shots[0].image.shape[1])
        row = np.hstack([cv2.resize(shot.image, (PANEL, height), interpolation=cv2.INTER_AREA) for shot in shots])
        rows.append(cv2.putText(row, str(number), (6, 22), cv2.FONT_HERSHEY_SIMPLEX, 0.7, (255, 255, 0), 2))
    drawing.write_picture(path, Image.fromarray(np.vstack(rows)))
