"""Predict images of the object at rest from the live images of a sensor, and show the live and the predicted images.

    python -m experiments.live                                            # starts a digital twin and serves a web page
    python -m experiments.live --sensor bench                             # the sensor of a sensor file
    python -m experiments.live --camera URL --leds PORT --sensor bench    # the same sensor under other addresses
    python -m experiments.live --sensor bench --record runs/monday        # also records both streams
    python -m experiments.live --replay runs/monday --loop                # predicts from a recording
    python -m experiments.live --headless --seconds 20 --save live.webp   # without a page

The command makes about ten predictions a second. The page shows the newest visual and tactile image, four samples of
the predicted images of the object at rest, and the probability of each outcome, such as "topples" or "fell off". The
page also shows whether the object touches the pad or is at rest, and the rate and the latency of the predictions. When
the object has come to rest, the prediction is the present.

The default model was trained only on simulated objects of the class `camera`, which are small cameras that a hand holds
and releases. At the first start, the compilation takes about two minutes for a twin and half a minute for the model.
"""

import contextlib
import dataclasses
import itertools
import tempfile
import time
from collections.abc import Callable, Generator, Iterator
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import PIL.Image
import tyro

import sts_jax as sts
from experiments.shared import drawing, interrupts, terminal
from experiments.shared.device import moving, own_twin
from experiments.shared.live import Image, Live, Views, check_model, follow, panel
from experiments.shared.page import LivePage
from experiments.shared.terminal import say
from sts_jax import hardware

PRINT_S = 1.0  # time between two lines in the terminal, and between two moments of the picture (s)
KEPT = 120  # moments in memory at which every second one is dropped
ROWS = 6  # largest number of moments in the picture, which are chosen evenly


@dataclasses.dataclass(frozen=True)
class Config:
    """Options of the command line: the source of the images, the model, and the outputs."""

    sensor: Path | None = None  # sensor file of experiments.commission, or its folder. None: start a digital twin
    camera: str | None = None  # path or URL of the camera. None: the camera of the sensor file
    leds: str | None = None  # serial port of the LED controller. None: found by the serial number in the sensor file
    # play back the recording in this folder, with the sensor file of `sensor` or of the recording
    replay: Path | None = None

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
    seconds: float | None = None  # stop after this time (s). None: stop at the end of a replay, or on Ctrl-C

    record: Path | None = None  # record both streams into this new folder
    # format of the videos: FFV1 is lossless, motion JPEG is faster and smaller
    encoding: Literal["ffv1", "mjpeg"] = "ffv1"
    save: Path | None = None  # write up to six moments of the live view and the predictions to a picture
    headless: bool = False  # print the predictions in this terminal instead of serving a page
    host: str = "127.0.0.1"  # address of the page. With 0.0.0.0, every computer of the network can watch
    port: int = 8766  # TCP port of the page. 0 selects a free one
    debug: bool = False  # show the traceback of every error


class Source(NamedTuple):
    """The source of the live images."""

    sensor: hardware.STS | hardware.Replay  # device or recording, not yet connected
    file: Path  # path of the sensor file or of its folder
    body: sts.objects.Body | None = None  # the body in view, if it is known


def check(config: Config) -> None:
    """Check the options before any work."""
    if config.replay is not None and (config.record, config.camera, config.leds) != (None, None, None):
        raise ValueError("--replay excludes --record, --camera and --leds. To duplicate a recording, copy its folder")
    if config.sensor is None and (config.camera, config.leds) != (None, None):
        raise ValueError("--sensor is missing: give the sensor file of `experiments.commission`")
    if (
        config.record is not None
        and config.record.exists()
        and (not config.record.is_dir() or any(config.record.iterdir()))
    ):
        raise ValueError(f"--record {config.record} must be a new or an empty folder: give another name")
    if config.dwell < 1:
        raise ValueError(f"--dwell must be >= 1, got {config.dwell}")
    if config.seconds is not None and not config.seconds > 0:
        raise ValueError(f"--seconds must be > 0, got {config.seconds}")
    if config.save is not None:
        drawing.check_picture(config.save)


def title(config: Config) -> str:
    """The source of the images and the model, for the page."""
    source = "a digital twin of the sensor" if config.sensor is None else f"the sensor of {config.sensor}"
    source = source if config.replay is None else f"a recording in {config.replay}"
    return f"{source}. Model: {config.model}"


@contextlib.contextmanager
def opened(config: Config, tell: Callable[[str], None]) -> Iterator[Source]:
    """Open the source that the options select. A digital twin runs until the end of the `with` block."""
    if config.replay is not None:
        replay = hardware.Replay(config.replay, speed=config.speed)
        yield Source(replay, config.sensor or config.replay)
    elif config.sensor is not None:
        yield Source(hardware.STS.from_file(config.sensor, camera=config.camera, leds=config.leds), config.sensor)
    else:
        tell("starting a digital twin. The first start compiles for about two minutes, later ones take half a minute")
        with tempfile.TemporaryDirectory() as folder, own_twin(Path(folder)) as (leds, hand), moving(hand):
            yield Source(hardware.STS.from_file(folder, leds=leds), Path(folder), hand.body)


def images(config: Config, source: Source) -> Generator[hardware.Shot, None, None]:
    """Read and record the images of a connected source, until it ends or the time `--seconds` is over."""
    sensor, started_s, recorder = source.sensor, time.monotonic(), None
    with contextlib.ExitStack() as stack:
        if isinstance(sensor, hardware.STS) and config.record is not None:
            origin = hardware.Origin.of(sensor)
            recorder = hardware.Recorder(config.record, origin, encoding=config.encoding, file=source.file)
            stack.callback(recorder.close)
        if isinstance(sensor, hardware.Replay):
            laps = itertools.count() if config.loop else range(1)
            shots: Iterator[hardware.Shot] = itertools.chain.from_iterable(sensor.connect().stream() for _ in laps)
        else:
            shots = sensor.stream(dwell=config.dwell)
        for shot in shots:
            if recorder is not None:
                recorder.add(shot)
            yield shot
            if config.seconds is not None and time.monotonic() > started_s + config.seconds:
                return
    say("the replay has ended")


def predict(config: Config, source: Source, predictor: sts.Predictor, page: LivePage | None) -> None:
    """Connect the source, and show and predict from its images until it ends or the user quits."""
    views = Views.load(source.file, divided=config.flat)
    moments, number, every = list[Image](), 0, 1
    with (
        Live(predictor, views, config.condition) as live,
        source.sensor,
        contextlib.closing(images(config, source)) as shots,
        interrupts.in_order(),
    ):
        live.body = source.body
        printed_s = time.monotonic()
        try:
            for seen in follow(live, shots):
                if page is not None:
                    page.show(seen)
                if seen.predicted is not None and time.monotonic() > printed_s + PRINT_S:
                    printed_s = time.monotonic()
                    if config.save is not None:
                        if number % every == 0:
                            moments.append(panel(seen))
                        number += 1
                        if len(moments) == KEPT:
                            del moments[1::2]
                            every *= 2
                    if page is None:
                        print(", ".join(seen.predicted.lines()), flush=True)
        except KeyboardInterrupt:
            say("stopped")
        say(live.summary)
    if config.save is not None and moments:
        save(config.save, moments)


def save(path: Path, moments: list[Image]) -> None:
    """Write up to `ROWS` of the moments to a picture, and print its path."""
    chosen = np.unique(np.linspace(0, len(moments) - 1, ROWS).round().astype(int))
    drawing.write_picture(path, PIL.Image.fromarray(np.vstack([moments[index] for index in chosen])))
    print(path)


def main(config: Config) -> None:
    """Load the model, and show predictions until the images end, the time `--seconds` is over, or a user quits."""
    with terminal.on_one_line(debug=config.debug):
        check(config)
        sts.enable_compilation_cache()
        predictor = sts.Predictor.load(config.model)
        check_model(predictor, config.condition)
        with contextlib.ExitStack() as stack:
            page, tell = None, say
            if not config.headless:
                page = LivePage(config.host, config.port, title=title(config))
                stack.callback(page.close)
                tell = page.tell
            source = stack.enter_context(opened(config, tell))
            tell("loading the model and connecting the sensor")
            predict(config, source, predictor, page)


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
