"""Predict images of the object at rest from the live images of a sensor, and show the live and the predicted images.

    python -m experiments.live                                            # starts a digital twin and serves a web page
    python -m experiments.live --sensor bench                             # the sensor of a sensor file
    python -m experiments.live --camera URL --leds PORT --sensor bench    # the same sensor under other addresses
    python -m experiments.live --sensor bench --record runs/monday        # also records both streams
    python -m experiments.live --replay runs/monday --loop                # predicts from a recording
    python -m experiments.live --headless --seconds 20 --save live.png    # without a page

The command makes about ten predictions a second. The page shows the newest visual and tactile image, the predicted
images of the object at rest, and the probability of each outcome, such as "topples" or "fell off". The page also shows
whether the object touches the pad, and the rate and the latency of the predictions.

The default model was trained only on simulated objects of the class `camera`, which are small cameras that a hand holds
and releases. At the first start, the compilation takes about two minutes for a twin and half a minute for the model.
"""

import collections
import contextlib
import dataclasses
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Literal

import numpy as np
import PIL.Image
import tyro

import sts_jax as sts
from experiments.shared import drawing, terminal
from experiments.shared.device import own_twin
from experiments.shared.live import Image, Live, Seen, Views, lines, panel
from experiments.shared.page import LivePage
from experiments.shared.terminal import say
from sts_jax import hardware

PRINT_S = 1.0  # time between two lines in the terminal, and between two moments of the picture (s)
ROWS = 6  # largest number of moments in the picture, which are chosen evenly


@dataclasses.dataclass(frozen=True)
class Config:
    """Options of the command line: the source of the images, the model, and the outputs."""

    sensor: Path | None = None  # sensor file of experiments.commission, or its folder
    camera: str | None = None  # path or URL of the camera. None: the camera of the sensor file
    leds: str | None = None  # serial port of the LED controller. None: found by the serial number in the sensor file
    replay: Path | None = None  # play back the recording in this folder
    twin: bool = False  # use a digital twin. This is the default if no other source is given

    # name of a model of the library (released, inclined, freefall or perturbed), or the folder of another model
    model: str = "released"
    # known quantities of the scenario that the model receives (SI units), such as the acceleration (x, y) and the
    # duration for perturbed. Empty: zeros
    condition: tuple[float, ...] = ()
    flat: bool = True  # remove vignetting: divide the images by the images of the empty pad in the sensor file

    # number of successive images of one stream before the lights switch. A larger number gives more images per second,
    # but the newest image of the other stream is older
    dwell: int = 3
    speed: float = 1.0  # speed of a replay. 2 is twice as fast as the recording
    loop: bool = False  # start a replay again when it has ended
    seed: int = 0  # seed of the twin's object and motion
    seconds: float | None = None  # stop after this time (s). None: stop at the end of a replay, or on Ctrl-C

    record: Path | None = None  # record both streams into this new folder
    # format of the videos: FFV1 is lossless, motion JPEG is faster and smaller
    encoding: Literal["ffv1", "mjpeg"] = "ffv1"
    save: Path | None = None  # write up to six moments of the live view and the predictions to a picture
    headless: bool = False  # print the predictions in this terminal instead of serving a page
    host: str = "127.0.0.1"  # address of the page. With 0.0.0.0, every computer of the network can watch
    port: int = 8766  # TCP port of the page. 0 selects a free one
    debug: bool = False  # show the traceback of every error


@dataclasses.dataclass(frozen=True, eq=False)
class Source:
    """The source of the live images: a sensor, a digital twin or a recording."""

    name: str  # description for the title of the page
    sensor: hardware.STS | hardware.Replay  # device or recording, not yet connected
    file: Path | None  # path of the sensor file, or None without one
    connected: Callable[[], None] = lambda: None  # function that is called when the sensor is connected
    note: Callable[[], str] = lambda: ""  # function that returns a remark on the present state of the source


def check(config: Config) -> None:
    """Check the options before any work."""
    sources = {
        "--twin": config.twin,
        "--replay": config.replay is not None,
        "--camera/--leds": config.camera is not None or config.leds is not None,
    }
    given = [name for name, there in sources.items() if there]
    if len(given) > 1 or (config.twin and config.sensor is not None):
        options = " and ".join(given if len(given) > 1 else ["--twin", "--sensor"])
        raise ValueError(f"{options} exclude each other: choose one source of images")
    if config.sensor is None and (config.camera is None) != (config.leds is None):
        missing = "--camera" if config.camera is None else "--leds"
        raise ValueError(f"{missing} is missing: give both --camera and --leds, or a sensor file with --sensor")
    if config.sensor is not None and not hardware.sensor_file.sensor_file(config.sensor).exists():
        raise ValueError(f"--sensor is {config.sensor}, but there is no sensor file: run `experiments.commission`")
    if config.dwell < 1:
        raise ValueError(f"--dwell must be >= 1, got {config.dwell}")
    if config.seconds is not None and not config.seconds > 0:
        raise ValueError(f"--seconds must be > 0, got {config.seconds}")
    if config.record is not None and config.replay is not None:
        raise ValueError(
            "--record and --replay exclude each other: leave out one of them. To duplicate a recording, copy its folder"
        )
    if config.save is not None:
        drawing.check_picture(config.save)


@contextlib.contextmanager
def opened(config: Config) -> Iterator[Source]:
    """Open the source that the options select. A digital twin runs until the end of the `with` block."""
    if config.replay is not None:
        replay = hardware.Replay(config.replay, speed=config.speed, loop=config.loop)
        file = config.replay if config.sensor is None and replay.device is not None else config.sensor
        yield Source(f"a recording in {config.replay}", replay, file)
    elif config.camera is not None and config.leds is not None and config.sensor is None:
        camera = hardware.CameraConfig(config.camera, None, None)
        yield Source(config.camera, hardware.STS(camera=camera, leds=config.leds), None)
    elif config.sensor is not None:
        sensor = hardware.STS.from_file(config.sensor, camera=config.camera, leds=config.leds)
        yield Source(f"the sensor of {config.sensor}", sensor, config.sensor)
    else:
        say("starting a digital twin. The first start compiles for about two minutes, later ones take half a minute")
        with tempfile.TemporaryDirectory() as folder, own_twin(Path(folder), seed=config.seed) as twin:
            sensor = hardware.STS.from_file(twin.folder, leds=twin.leds)
            yield Source("a digital twin of the sensor", sensor, twin.folder, twin.start, lambda: twin.note)


def views(config: Config, source: Source, first: hardware.Shot) -> Views:
    """The conversion from raw images. Without a sensor file, the lens is ideal for images of the size of `first`."""
    if source.file is None:
        height, width = first.image.shape[:2]
        say(
            "note: without a sensor file, an ideal lens of 160 degrees is assumed, contact is unknown, and vignetting "
            "is not removed. Give --sensor"
        )
        return Views(hardware.Lens.ideal(width, height), sts.Sensor().camera, None)
    device = hardware.Device.load(source.file)
    pinhole = sts.Sensor.load(hardware.sensor_file.sensor_file(source.file)).camera
    return Views(device.lens, pinhole, device.backgrounds(source.file), config.flat)


def images(config: Config, source: Source) -> Iterator[hardware.Shot]:
    """Read the images of both streams from the connected source, until the source ends."""
    if isinstance(source.sensor, hardware.Replay):
        return source.sensor.stream()
    return source.sensor.stream(0.5, dwell=config.dwell)


class Screen:
    """The outputs of the command: the page or the lines in the terminal, and the picture of `--save`."""

    def __init__(self, config: Config, source: Source, views: Views, page: LivePage | None):
        """Prepare the outputs. Without a page, they are printed."""
        self._source, self._views, self._page, self._path = source, views, page, config.save
        self._panels: list[Image] = []  # moments of which the picture shows some
        self._shown: dict[str, tuple[Image, float]] = {}  # newest image of each stream and the time of its arrival (s)
        self._arrived_s: collections.deque[float] = collections.deque(maxlen=100)
        self._printed_s = time.monotonic()
        self._recorded = 0 if config.record is not None else None
        self.live: Live | None = None

    def add(self, shot: hardware.Shot) -> None:
        """Show a new image."""
        self._shown = {**self._shown, shot.stream: (self._views.shown(shot.image), shot.time_s)}
        self._arrived_s.append(shot.time_s)
        if self._recorded is not None:
            self._recorded += 1
        self.update()
        seen, now_s = self.seen(), time.monotonic()
        if seen is None or seen.predicted is None or now_s < self._printed_s + PRINT_S:
            return
        self._printed_s = now_s
        if self._path is not None and seen.rate > 0:
            self._panels.append(panel(seen))
        if self._page is None:
            chances = (f"{name} {chance:.2f}" for name, chance in seen.predicted.outcomes)
            print(", ".join([*lines(seen), *chances]), flush=True)

    def update(self) -> None:
        """Update the page, from the main thread after each image, and from the other one after each prediction."""
        seen = self.seen()
        if self._page is not None and seen is not None:
            self._page.show(seen)

    def seen(self) -> Seen | None:
        """The newest images and the newest prediction, or None until there is an image of each stream."""
        shown, live, arrived_s = self._shown, self.live, list(self._arrived_s)
        if len(shown) < 2 or live is None:
            return None
        rate = (len(arrived_s) - 1) / max(arrived_s[-1] - arrived_s[0], 1e-3)
        (visual, visual_s), (tactile, tactile_s) = shown["visual"], shown["tactile"]
        newest_s, note = max(visual_s, tactile_s), self._source.note()
        return Seen(visual, tactile, newest_s, rate, live.newest, live.rate, live.latency_s, self._recorded, note)

    def close(self) -> None:
        """Write the picture, and print its path."""
        if self._path is not None and self._panels:
            chosen = np.unique(np.linspace(0, len(self._panels) - 1, ROWS).round().astype(int))
            picture = np.vstack([self._panels[index] for index in chosen])
            drawing.write_picture(self._path, PIL.Image.fromarray(picture))
            print(self._path)


def follow(config: Config, source: Source, predictor: sts.Predictor, page: LivePage | None) -> None:
    """Connect the source, and show, predict from and record its images until it ends or the user quits."""
    with source.sensor as sensor, contextlib.ExitStack() as stack:
        prepared = views(config, source, next(images(config, source)))
        screen = Screen(config, source, prepared, page)
        stack.callback(screen.close)
        live = stack.enter_context(Live(predictor, prepared, config.condition, screen.update))
        screen.live = live
        recorder = None
        if isinstance(sensor, hardware.Replay):
            sensor.connect()  # the clock starts now
        elif config.record is not None:
            origin = hardware.Origin.of(sensor)
            recorder = hardware.Recorder(config.record, origin, encoding=config.encoding, file=source.file)
            stack.callback(recorder.close)
        source.connected()
        started_s, newest = time.monotonic(), dict[str, hardware.Shot]()
        try:
            for shot in images(config, source):
                newest[shot.stream] = shot
                if recorder is not None:
                    recorder.add(shot)
                if len(newest) == 2:
                    live.offer(newest["visual"], newest["tactile"])
                screen.add(shot)
                if config.seconds is not None and time.monotonic() > started_s + config.seconds:
                    break
            else:
                say("the replay has ended")
        except KeyboardInterrupt:
            say("stopped")
        summarise(live, sensor, time.monotonic() - started_s)
        if recorder is not None:
            counts = recorder.counts
            say(f"{counts['visual']} visual and {counts['tactile']} tactile images in {recorder.folder}")


def summarise(live: Live, sensor: hardware.STS | hardware.Replay, duration_s: float) -> None:
    """Print the number, the rate and the latency of the predictions."""
    if live.latency_s is None:
        say("no prediction was made, because the command ended before both streams had an image")
        return
    missed = f", {sensor.skipped} images of the recording skipped" if isinstance(sensor, hardware.Replay) else ""
    say(
        f"{live.made} predictions in {duration_s:.1f} s: {live.made / duration_s:.1f} per second, median latency "
        f"{1000 * live.latency_s:.0f} ms, {live.offered - live.made} images without a prediction of their own{missed}"
    )


def main(config: Config) -> None:
    """Load the model, and show predictions until the images end, the time `--seconds` is over, or a user quits."""
    with terminal.on_one_line(debug=config.debug):
        try:
            check(config)
            sts.enable_compilation_cache()
            predictor = sts.Predictor.load(config.model)
            with contextlib.ExitStack() as stack:
                source = stack.enter_context(opened(config))
                page = None
                if not config.headless:
                    page = LivePage(config.host, config.port, title=f"{source.name}. Model: {config.model}")
                    stack.callback(page.close)
                    page.announce("watch")
                follow(config, source, predictor, page)
        except KeyboardInterrupt:
            raise SystemExit("stopped") from None


if __name__ == "__main__":
    terminal.interrupt_on_sigterm()
    main(tyro.cli(Config, description=__doc__))
