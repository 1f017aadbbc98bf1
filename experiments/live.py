"""Show the predicted resting state beside the live images, about ten times a second.

    python -m experiments.live                                            # starts a digital twin and opens a page
    python -m experiments.live --sensor bench                             # the sensor of a sensor file
    python -m experiments.live --camera URL --leds PORT --sensor bench    # names the devices of the file
    python -m experiments.live --sensor bench --record runs/monday        # and records both streams
    python -m experiments.live --replay runs/monday --loop                # plays them back, with predictions
    python -m experiments.live --replay visual.mp4 tactile.mp4 --sensor bench
    python -m experiments.live --headless --seconds 20 --save live.png    # without a page

The page shows both streams in the view of the sensor, the predicted images at rest, the probabilities of the outcomes,
contact, and the rate and the latency of the predictions. The default model was trained on simulated cameras that are
held and released. At its first start, a twin compiles for about two minutes and the model for half a minute.
"""

import collections
import contextlib
import dataclasses
import signal
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Literal

import tyro

import sts_jax as sts
from experiments.shared import errors
from experiments.shared.live import Backgrounds, Image, Live, Seen, Views
from experiments.shared.live_page import LivePage
from experiments.shared.live_panel import PanelFile, lines
from experiments.shared.own_twin import own_twin
from experiments.shared.progress import say
from sts_jax import hardware

SCENARIOS: dict[str, type[sts.physics.Scenario]] = {
    "freefall": sts.physics.Freefall,
    "inclined": sts.physics.Inclined,
    "perturbed": sts.physics.Perturbed,
    "released": sts.physics.Released,
}
PRINT_S = 1.0  # s, between two lines in the terminal


@dataclasses.dataclass(frozen=True)
class Config:
    """The source of the images, the model, and the outputs."""

    sensor: Path | None = None  # sensor file of the commissioning, or its folder
    camera: str | None = None  # device or URL (default: that of the sensor file)
    leds: str | None = None  # serial port of the LED controller (default: found by the sensor file's serial number)
    replay: tuple[Path, ...] = ()  # folder of a recording, or two videos: visual and tactile
    twin: bool = False  # start a digital twin. Default if no other source is given

    # released, inclined, freefall or perturbed, which come with the library, or a model's folder
    model: str = "released"
    scenario: Literal["freefall", "inclined", "perturbed", "released"] | None = None  # of a model's folder, for names
    condition: tuple[float, ...] = ()  # of the model, SI units (default: zeros)
    flat: bool = True  # divide out the backgrounds of the sensor file, such as vignetting

    dwell: int = 3  # images of one stream before the lights switch. More give a higher rate and older images
    speed: float = 1.0  # recorded seconds in a second
    loop: bool = False  # start a recording again at its end
    seed: int = 0  # of the twin
    seconds: float | None = None  # stop after this time (default: at the end of a recording, or never)

    record: Path | None = None  # record both streams into this new folder
    encoding: Literal["png", "jpeg"] = "png"  # of the recorded images. PNG is lossless, JPEG faster and smaller
    save: Path | None = None  # write a picture (.png) or a video (.mp4) of the view
    headless: bool = False  # print in this terminal instead of showing a page
    host: str = "127.0.0.1"  # address of the page. 0.0.0.0: every computer of the network can watch
    port: int = 8766  # of the page, 0: a free one
    debug: bool = False  # show the traceback of every error


@dataclasses.dataclass(frozen=True, eq=False)
class Source:
    """Where the images come from. The sensor is not connected yet."""

    name: str
    sensor: hardware.STS | hardware.Replay
    file: Path | None  # the sensor file
    connected: Callable[[], None] = lambda: None  # called after the connection
    note: Callable[[], str] = lambda: ""


def check(config: Config) -> None:
    """Check the options before any work.

    Raises:
        ValueError: Two options contradict each other, or one is out of range.
    """
    given = [
        name
        for name, there in (
            ("--twin", config.twin),
            ("--replay", bool(config.replay)),
            ("--camera and --leds", config.camera is not None or config.leds is not None),
        )
        if there
    ]
    if len(given) > 1 or (config.twin and config.sensor is not None):
        raise ValueError(f"{' and '.join(given if len(given) > 1 else ['--twin', '--sensor'])} exclude each other")
    if len(config.replay) > 2:
        raise ValueError(
            f"replay has {len(config.replay)} paths, but it takes a folder, or a visual and a tactile video"
        )
    if config.sensor is None and (config.camera is None) != (config.leds is None):
        raise ValueError("without a sensor file, both --camera and --leds are needed")
    if config.sensor is not None and not hardware.sensor_file.sensor_file(config.sensor).exists():
        raise ValueError(
            f"sensor is {config.sensor}, but there is no sensor file: give another one, or write it with `python -m "
            "experiments.commission`"
        )
    if config.dwell < 1:
        raise ValueError(f"dwell must be >= 1, got {config.dwell}")
    if config.seconds is not None and not config.seconds > 0:
        raise ValueError(f"seconds must be > 0, got {config.seconds}")
    if config.record is not None and config.replay:
        raise ValueError("--record and --replay exclude each other: copy the folder of the recording instead")


@contextlib.contextmanager
def opened(config: Config) -> Iterator[Source]:
    """The source of the options. A twin is started, and ended afterwards."""
    if config.replay:
        yield replayed(config)
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


def replayed(config: Config) -> Source:
    """A recording. Its copy of the sensor file is used unless another one is given."""
    first, file = config.replay[0], config.sensor
    path = first if len(config.replay) == 1 else (first, config.replay[1])
    sensor = hardware.Replay(path, speed=config.speed, loop=config.loop)
    if file is None and sensor.device is not None:
        file = first
    return Source(f"a recording in {first.parent if isinstance(path, tuple) else first}", sensor, file)


def views(config: Config, source: Source, first: hardware.Shot) -> Views:
    """How raw images become those of the sensor's view.

    Args:
        config: The options.
        source: The source.
        first: An image of the source. A lens that is assumed for lack of a sensor file has its size.
    """
    if source.file is None:
        height, width = first.image.shape[:2]
        say(
            "there is no sensor file, so a lens of 160 degrees without error is assumed, contact is unknown, and "
            "vignetting stays. Give --sensor"
        )
        return Views(hardware.Lens.ideal(width, height), sts.Sensor().camera, None)
    device = hardware.Device.load(source.file)
    pinhole = sts.Sensor.load(hardware.sensor_file.sensor_file(source.file)).camera
    backgrounds = None
    if device.background_visual is not None and device.background_tactile is not None:
        backgrounds = Backgrounds(
            device.background(source.file, "visual"), device.background(source.file, "tactile"), config.flat
        )
    return Views(device.lens, pinhole, backgrounds)


def images(config: Config, source: Source) -> Iterator[hardware.Shot]:
    """The images of the connected source."""
    if isinstance(source.sensor, hardware.Replay):
        return source.sensor.stream()
    return source.sensor.stream(0.5, dwell=config.dwell)


class Screen:
    """What is shown: the newest images and predictions. The page, the terminal and the file show it."""

    def __init__(self, config: Config, source: Source, views: Views, page: LivePage | None):
        """Check the file's path."""
        self._source, self._views, self._page = source, views, page
        self._file = None if config.save is None else PanelFile(config.save)
        self._path = config.save
        self._shown: dict[str, tuple[Image, float]] = {}  # by stream, with the time of its arrival (s)
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
        seen = self.seen()
        if seen is None:
            return
        if self._file is not None:
            self._file.add(seen)
        if self._page is None and time.monotonic() > self._printed_s + PRINT_S and seen.predicted is not None:
            self._printed_s = time.monotonic()
            chances = (f"{name} {chance:.2f}" for name, chance in seen.predicted.outcomes)
            print(", ".join([*lines(seen), *chances]), flush=True)

    def update(self) -> None:
        """Update the page, also from the thread of the predictions."""
        seen = self.seen()
        if self._page is not None and seen is not None:
            self._page.show(seen)

    def seen(self) -> Seen | None:
        """The current state, or None before the first pair."""
        shown, live, arrived_s = self._shown, self.live, list(self._arrived_s)
        if len(shown) < 2 or live is None:
            return None
        rate = (len(arrived_s) - 1) / max(arrived_s[-1] - arrived_s[0], 1e-3)
        (visual, visual_s), (tactile, tactile_s) = shown["visual"], shown["tactile"]
        return Seen(
            visual,
            tactile,
            max(visual_s, tactile_s),
            rate,
            live.newest,
            live.rate,
            live.latency_s,
            self._recorded,
            self._source.note(),
        )

    def close(self) -> None:
        """Write the file."""
        if self._file is not None and self._file.close():
            print(self._path)


def follow(config: Config, source: Source, predictor: sts.Predictor, page: LivePage | None) -> None:
    """Show, predict and record until the end."""
    name = config.scenario or (config.model if config.model in SCENARIOS else None)
    outcomes = () if name is None else tuple(str(outcome) for outcome in SCENARIOS[name].outcomes)
    with source.sensor as sensor, contextlib.ExitStack() as stack:
        prepared = views(config, source, next(images(config, source)))
        screen = Screen(config, source, prepared, page)
        stack.callback(screen.close)
        live = stack.enter_context(Live(predictor, prepared, outcomes, config.condition, screen.update))
        screen.live = live
        recorder = None
        if isinstance(sensor, hardware.Replay):
            sensor.connect()  # the clock starts now
        elif config.record is not None:
            origin = hardware.Origin.of(sensor)
            recorder = hardware.Recorder(
                config.record, origin, settling=sensor.settling, encoding=config.encoding, file=source.file
            )
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
        except hardware.EndOfVideoError as error:
            say(str(error))
        except KeyboardInterrupt:
            say("stopped")
        summarise(live, sensor, time.monotonic() - started_s)
        if recorder is not None:
            counts = recorder.counts
            say(f"{counts['visual']} visual and {counts['tactile']} tactile images in {recorder.folder}")


def summarise(live: Live, sensor: hardware.STS | hardware.Replay, duration_s: float) -> None:
    """Print rate and latency of the whole run."""
    if live.latency_s is None:
        say("there was no prediction, because the images ended before both streams had come")
        return
    missed = f", {sensor.skipped} images of the recording came too late" if isinstance(sensor, hardware.Replay) else ""
    say(
        f"{live.made} predictions in {duration_s:.1f} s: {live.made / duration_s:.1f} per second, median latency "
        f"{1000 * live.latency_s:.0f} ms, {live.offered - live.made} images without a prediction of their own{missed}"
    )


def main(config: Config) -> None:
    """Open source, model and page."""
    with errors.on_one_line(debug=config.debug):
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
                    reach = "only this computer" if page.is_local else "EVERY computer that reaches this address"
                    say(f"open {page.url} in a browser. The page listens on {config.host}: {reach} can watch")
                follow(config, source, predictor, page)
        except KeyboardInterrupt:
            raise SystemExit("stopped") from None


def _terminated(*_: object) -> None:
    raise KeyboardInterrupt  # so that files are closed, as after Ctrl+C


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, _terminated)
    warnings.formatwarning = lambda message, *_, **__: f"note: {message}\n"
    main(tyro.cli(Config, description=__doc__))
