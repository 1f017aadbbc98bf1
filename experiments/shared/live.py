"""Predicts images of the resting object from live images in a thread, and draws what a live display shows.

Live images that arrive while the model is busy are skipped, and never queued.
"""

import collections
import dataclasses
import os
import statistics
import threading
import time
from collections.abc import Mapping
from typing import NamedTuple

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, UInt8

import sts_jax as sts
from sts_jax import hardware
from sts_jax.hardware import collecting

SIDE = 384  # side of the images that are shown (pixels)
_RECENT = 400  # number of predictions from which their rate and latency are computed
_OCCUPIED = 8.0  # difference of a block of the visual image from the empty pad that counts as a change, of 255
_BLOCKS = 3  # number of changed blocks that show an object

_SMALL = 240  # side of an image in a panel (pixels)
_LINE = 24  # height of a line of text (pixels)

Image = UInt8[np.ndarray, "height width 3"]


class Predicted(NamedTuple):
    """A prediction of the resting state, and facts about the input images and about all predictions."""

    visual: Image  # predicted visual image at rest, the mean over the model's samples
    tactile: Image  # predicted tactile image at rest
    outcomes: list[tuple[str, float]]  # names and probabilities of the outcomes, empty if the model predicts none
    contact: bool  # True if the object touches the pad now
    occupied: bool  # True if an object is in view
    rate: float = 0.0  # predictions per second
    latency_ms: float = 0.0  # median time from the arrival of an input's newer image until its prediction is made (ms)

    def lines(self) -> list[str]:
        """The rate, the latency, the contact and the outcomes, as lines of text."""
        touch = "contact" if self.contact else "no contact" if self.occupied else "nothing on the pad"
        outcomes = (f"{name} {chance:.2f}" for name, chance in self.outcomes)
        return [f"{self.rate:.1f} predictions/s", f"latency {self.latency_ms:.0f} ms", touch, *outcomes]


class Seen(NamedTuple):
    """All content of the live display at one time."""

    visual: Image  # newest visual image, in the view of the sensor
    tactile: Image  # newest tactile image, in the view of the sensor
    time_s: float  # arrival of the newest image, on the clock `time.monotonic` (s)
    predicted: Predicted | None  # newest prediction, or None before the first one


def panel(seen: Seen) -> Image:
    """Draw the live images, the predicted images and the lines of text in one row."""
    assert seen.predicted is not None
    images = seen.visual, seen.tactile, seen.predicted.visual, seen.predicted.tactile
    text = np.full((_SMALL, _SMALL, 3), 255, np.uint8)
    for number, line in enumerate(seen.predicted.lines(), 1):
        cv2.putText(text, line, (8, number * _LINE), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 0), 1, cv2.LINE_AA)
    small = [cv2.resize(image, (_SMALL, _SMALL), interpolation=cv2.INTER_AREA) for image in images]
    return np.hstack([*small, text])


@dataclasses.dataclass(frozen=True, eq=False)
class Views:
    """The conversion from raw images to the view of the sensor."""

    lens: hardware.Lens  # lens of the raw images
    pinhole: sts.optics.Camera  # view of the sensor
    empty: tuple[Image, Image]  # raw visual and tactile image of the empty pad
    divided: bool = True  # divide the images for the model by the images of the empty pad

    @classmethod
    def load(cls, path: str | os.PathLike, *, divided: bool) -> "Views":
        """The conversion that a sensor file with backgrounds describes."""
        device, file = hardware.Device.load(path), hardware.sensor_file.sensor_file(path)
        backgrounds = device.backgrounds(path)
        if backgrounds is None:
            raise ValueError(f"{file} has no images of the empty pad: run `python -m experiments.commission` again")
        return cls(device.lens, sts.Sensor.load(file).camera, backgrounds, divided)

    def shown(self, image: Image) -> Image:
        """Rectify a raw image for display, to (SIDE, SIDE, 3)."""
        return hardware.rectified(self.lens, self.pinhole, image, (SIDE, SIDE))

    def prepared(self, visual: Image, tactile: Image, empty: Mapping[str, np.ndarray]) -> hardware.SensorView:
        """Convert raw images to the inputs of a model whose empty sensor looks like `empty` (`Predictor.empty`)."""
        model = hardware.SensorView(**empty)
        rows, columns = model.visual.shape[:2]
        view, background = (
            hardware.sensor_view(self.lens, self.pinhole, *pair, (rows, columns))
            for pair in ((visual, tactile), self.empty)
        )
        return hardware.relit(view, background, model) if self.divided else view


class Live:
    """Predicts the resting state in a background thread, always from the newest images.

    ```python
    with Live(predictor, views, condition=()) as live:
        live.offer(visual, tactile)  # the newest two images
        live.newest  # the newest prediction, or None before the first one
    ```
    """

    def __init__(self, predictor: sts.Predictor, views: Views, condition: tuple[float, ...]):
        """Compile the model, and start the thread. An empty `condition` stands for zeros."""
        if "visual" not in predictor.modalities:
            raise ValueError(f"--model must take visual images as inputs: give another one than {predictor!r}")
        width = predictor.model.config.condition
        if len(condition) not in (0, width):
            raise ValueError(f"--condition must have {width} values, got {len(condition)}, for {predictor!r}")
        self._predictor, self._views = predictor, views
        self._condition = np.asarray(condition or (0.0,) * width, np.float32) if width else None
        self._untouched = predictor.empty
        self._touches = "tactile" in predictor.modalities
        self._empty = hardware.known_pad(*views.empty)
        self.newest: Predicted | None = None  # the newest prediction
        self.made = self.offered = 0  # numbers of predictions and of pairs so far
        # times and latencies of the last predictions (s)
        self._recent: collections.deque[tuple[float, float]] = collections.deque(maxlen=_RECENT)
        self._waiting: collections.deque[tuple[hardware.Shot, hardware.Shot]] = collections.deque(maxlen=1)
        self._changed, self._stopped = threading.Event(), False
        self._error: Exception | None = None
        self._compute(self._untouched, occupied=False, contact=True)
        self._thread = threading.Thread(target=self._run, name="predictions", daemon=True)
        self._thread.start()

    def offer(self, visual: hardware.Shot, tactile: hardware.Shot) -> None:
        """Pass the newest images to the thread, or raise the error of an earlier prediction, which ended the thread."""
        if self._error is not None:
            raise self._error
        self._waiting.append((visual, tactile))
        self.offered += 1
        self._changed.set()

    def __enter__(self) -> "Live":
        return self

    def __exit__(self, *_: object) -> None:
        self._stopped = True
        self._changed.set()
        self._thread.join()

    def _run(self) -> None:
        try:
            while self._changed.wait() and not self._stopped:
                self._changed.clear()
                if self._waiting:
                    visual, tactile = self._waiting.pop()
                    predicted = self._predict(visual, tactile)
                    now_s = time.monotonic()
                    self._recent.append((now_s, now_s - max(visual.time_s, tactile.time_s)))
                    times_s, latencies_s = zip(*self._recent, strict=True)
                    rate = (len(times_s) - 1) / max(now_s - times_s[0], 1e-3)
                    latency_ms = 1000 * statistics.median(latencies_s)
                    self.newest = predicted._replace(rate=rate, latency_ms=latency_ms)
                    self.made += 1
        except Exception as error:  # the next call of `offer` raises this error
            self._error = error

    def _predict(self, visual: hardware.Shot, tactile: hardware.Shot) -> Predicted:
        """Predict from raw images."""
        observation = collecting.observe(tactile.time_s, visual.image, tactile.image)
        contact = collecting.has_contact(hardware.GuideConfig(), self._empty, observation)
        change = np.abs(observation.visual - self._empty.mean.visual).max(-1)
        occupied = contact or int((change > _OCCUPIED).sum()) >= _BLOCKS
        view = self._views.prepared(visual.image, tactile.image, self._untouched)
        out = self._compute(view._asdict(), occupied=occupied, contact=contact)
        chances = [] if out.outcome_probability is None else np.asarray(out.outcome_probability).tolist()
        names = self._predictor.outcomes or tuple(f"outcome {number}" for number in range(len(chances)))
        outcomes = list(zip(names, chances, strict=True))
        return Predicted(_shown(out.visual), _shown(out.tactile), outcomes, contact, occupied)

    def _compute(self, views: Mapping[str, np.ndarray], *, occupied: bool, contact: bool) -> sts.Prediction:
        """Predict from images in the view of the sensor. An image of the empty pad or without contact is ignored."""
        touch = views["tactile"] if self._touches else None
        present: dict[str, ArrayLike] = {"visual": np.bool_(occupied)}
        if touch is not None:
            present["tactile"] = np.bool_(contact)
        out = self._predictor(visual=views["visual"], tactile=touch, condition=self._condition, present=present)
        return jax.block_until_ready(out)


def _shown(image: Float[Array, "height width 3"] | None) -> Image:
    """Convert a predicted image in [0, 1] to uint8 in the size for display. None becomes a black image."""
    pixels = np.zeros((1, 1, 3)) if image is None else np.asarray(jnp.clip(image, 0, 1))
    return cv2.resize(np.round(255 * pixels).astype(np.uint8), (SIDE, SIDE), interpolation=cv2.INTER_CUBIC)
