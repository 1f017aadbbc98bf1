"""Predicts images of the resting object from live images in a thread, and draws what a live display shows.

Live images that arrive while the model is busy are skipped, and never queued.
"""

import collections
import dataclasses
import statistics
import threading
import time
from collections.abc import Callable, Mapping
from typing import NamedTuple

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, UInt8
from PIL import Image as Pictures
from PIL import ImageDraw, ImageFont

import sts_jax as sts
from sts_jax import hardware
from sts_jax.hardware import guide

SIDE = 384  # side of the images that are shown (pixels)
_RECENT_S = 3.0  # time over which the rate is measured (s)
_KEPT = 4096  # number of latencies from which the median is computed
_OCCUPIED = 8.0  # difference of a block of the visual image from the empty pad that counts as a change, of 255
_BLOCKS = 3  # number of changed blocks that show an object

_SMALL = 240  # side of an image in a panel (pixels)
_GAP = 8  # distance between two images (pixels)
_HEAD = 24  # height of the titles (pixels)
_TEXT = 220  # width of the text (pixels)
_TITLES = ("visual, now", "tactile, now", "visual, predicted at rest", "tactile, predicted at rest")
_BAR = "#3f51b5"

Image = UInt8[np.ndarray, "height width 3"]


@dataclasses.dataclass(frozen=True, eq=False)
class Predicted:
    """A prediction of the resting state, and facts about the input images."""

    visual: Image  # predicted visual image at rest, the mean over the model's samples
    tactile: Image  # predicted tactile image at rest
    outcomes: list[tuple[str, float]]  # names and probabilities of the outcomes, empty if the model predicts none
    contact: bool | None  # True if the object touches the pad now. None: unknown without images of the empty pad
    occupied: bool | None  # True if an object is in view. None: unknown without images of the empty pad
    newest_s: float  # arrival of the newer input image, on the clock `time.monotonic` (s)


class Seen(NamedTuple):
    """All content of the live display at one time."""

    visual: Image  # newest visual image, in the view of the sensor
    tactile: Image  # newest tactile image, in the view of the sensor
    time_s: float  # arrival of the newest image, on the clock `time.monotonic` (s)
    images_per_s: float  # images per second of both streams together
    predicted: Predicted | None  # newest prediction, or None before the first one
    rate: float  # predictions per second
    latency_s: float | None  # median time from the arrival of an input's newer image until its prediction is shown (s)
    recorded: int | None  # number of images in the recording, or None if nothing is recorded
    note: str  # remark on the source


@dataclasses.dataclass(frozen=True, eq=False)
class Views:
    """The conversion from raw images to the view of the sensor."""

    lens: hardware.Lens  # lens of the raw images
    pinhole: sts.optics.Camera  # view of the sensor
    empty: tuple[Image, Image] | None  # raw visual and tactile image of the empty pad, if they are known
    divided: bool = True  # divide the images for the model by the images of the empty pad

    def shown(self, image: Image) -> Image:
        """Rectify a raw image for display, to (SIDE, SIDE, 3)."""
        return hardware.rectified(self.lens, self.pinhole, image, (SIDE, SIDE))

    def rectified(self, images: tuple[Image, Image], size: tuple[int, int]) -> hardware.SensorView:
        """Rectify a raw visual and a raw tactile image, to float32 RGB in [0, 1]."""
        rectified = (hardware.rectified(self.lens, self.pinhole, image, size) for image in images)
        return hardware.SensorView(*(image.astype(np.float32) / 255 for image in rectified))

    def prepared(self, visual: Image, tactile: Image, empty: Mapping[str, np.ndarray]) -> hardware.SensorView:
        """Convert raw images to the inputs of a model whose empty sensor looks like `empty` (`Predictor.empty`)."""
        model = hardware.SensorView(**empty)
        rows, columns = model.visual.shape[:2]
        view = self.rectified((visual, tactile), (rows, columns))
        if self.empty is None or not self.divided:
            return view
        return hardware.relit(view, self.rectified(self.empty, (rows, columns)), model)


class Live:
    """Predicts the resting state in a background thread, always from the newest images.

    ```python
    with Live(predictor, views, condition=(), show=update_page) as live:
        live.offer(visual, tactile)  # the newest two images
        live.newest  # the newest prediction, or None before the first one
    ```
    """

    def __init__(
        self,
        predictor: sts.Predictor,
        views: Views,
        condition: tuple[float, ...],
        show: Callable[[], None],
    ):
        """Compile the model, and start the thread, which calls `show` after each prediction.

        The first compilation on a machine takes half a minute. An empty `condition` stands for zeros.
        """
        if "visual" not in predictor.modalities:
            raise ValueError(f"--model must take visual images as inputs: give another one than {predictor!r}")
        width = predictor.model.config.condition
        if len(condition) not in (0, width):
            raise ValueError(f"--condition must have {width} values, got {len(condition)}, for {predictor!r}")
        self._predictor, self._views = predictor, views
        self._condition = np.asarray(condition or (0.0,) * width, np.float32) if width else None
        self._show = show
        self._untouched = predictor.empty
        self._touches = "tactile" in predictor.modalities
        self._empty = None if views.empty is None else hardware.known_pad(*views.empty)
        self.offered = self.made = 0
        self._latencies_s: collections.deque[float] = collections.deque(maxlen=_KEPT)
        self._shown_s: collections.deque[float] = collections.deque(maxlen=_KEPT)
        self._changed = threading.Condition()
        self._next: tuple[hardware.Shot, hardware.Shot] | None = None
        self._newest: Predicted | None = None
        self._error: BaseException | None = None
        self._stopped = False
        self._compute(self._untouched, contact=True)
        self._thread = threading.Thread(target=self._run, name="predictions", daemon=True)
        self._thread.start()

    def offer(self, visual: hardware.Shot, tactile: hardware.Shot) -> None:
        """Pass the newest images to the thread, or raise the error of an earlier prediction, which ended the thread."""
        with self._changed:
            if self._error is not None:
                raise self._error
            self._next = visual, tactile
            self.offered += 1
            self._changed.notify_all()

    @property
    def newest(self) -> Predicted | None:
        """The newest prediction, or None before the first one."""
        with self._changed:
            return self._newest

    @property
    def rate(self) -> float:
        """Predictions per second over the last three seconds."""
        now_s = time.monotonic()
        with self._changed:
            recent = [shown_s for shown_s in self._shown_s if shown_s > now_s - _RECENT_S]
        return (len(recent) - 1) / (recent[-1] - recent[0]) if len(recent) > 1 else 0.0

    @property
    def latency_s(self) -> float | None:
        """Median time from the arrival of a prediction's newer input until it is shown (s), or None at first."""
        with self._changed:
            return statistics.median(self._latencies_s) if self._latencies_s else None

    def close(self) -> None:
        """Stop the thread."""
        with self._changed:
            self._stopped = True
            self._changed.notify_all()
        self._thread.join()

    def __enter__(self) -> "Live":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _run(self) -> None:
        try:
            while (shots := self._taken()) is not None:
                predicted = self._predict(*shots)
                with self._changed:
                    self._newest = predicted
                self._show()
                now_s = time.monotonic()
                with self._changed:
                    self.made += 1
                    self._shown_s.append(now_s)
                    self._latencies_s.append(now_s - predicted.newest_s)
        except Exception as error:  # the next call of `offer` raises this error
            with self._changed:
                self._error = error

    def _taken(self) -> tuple[hardware.Shot, hardware.Shot] | None:
        """Wait for the next images. None: the thread must stop."""
        with self._changed:
            self._changed.wait_for(lambda: self._stopped or self._next is not None)
            shots, self._next = self._next, None
            return None if self._stopped else shots

    def _predict(self, visual: hardware.Shot, tactile: hardware.Shot) -> Predicted:
        """Predict from raw images."""
        contact, occupied = self._contact(visual, tactile)
        view = self._views.prepared(visual.image, tactile.image, self._untouched)
        out = self._compute(view._asdict(), contact=contact is not False)
        chances = [] if out.outcome_probability is None else np.asarray(out.outcome_probability).tolist()
        names = self._predictor.outcomes or tuple(f"outcome {number}" for number in range(len(chances)))
        return Predicted(
            _shown(out.visual),
            _shown(out.tactile),
            list(zip(names, chances, strict=True)),
            contact,
            occupied,
            max(visual.time_s, tactile.time_s),
        )

    def _compute(self, views: Mapping[str, np.ndarray], *, contact: bool) -> sts.Prediction:
        """Predict from images in the view of the sensor. The tactile image is ignored unless `contact` is True."""
        touch = views["tactile"] if self._touches else None
        present: dict[str, ArrayLike] | None = None if touch is None else {"tactile": np.bool_(contact)}
        out = self._predictor(visual=views["visual"], tactile=touch, condition=self._condition, present=present)
        return jax.block_until_ready(out)

    def _contact(self, visual: hardware.Shot, tactile: hardware.Shot) -> tuple[bool | None, bool | None]:
        """Return whether the object touches the pad, and whether one of the images shows an object."""
        if self._empty is None:
            return None, None
        observation = guide.observe(tactile.time_s, visual.image, tactile.image)
        contact = guide.has_contact(hardware.GuideConfig(), self._empty, observation)
        change = np.abs(observation.visual - self._empty.mean.visual).max(-1)
        return contact, contact or int((change > _OCCUPIED).sum()) >= _BLOCKS


def _shown(image: Float[Array, "height width 3"] | None) -> Image:
    """Convert a predicted image in [0, 1] to uint8 in the size for display. None becomes a black image."""
    pixels = np.zeros((1, 1, 3)) if image is None else np.asarray(jnp.clip(image, 0, 1))
    return cv2.resize(np.round(255 * pixels).astype(np.uint8), (SIDE, SIDE), interpolation=cv2.INTER_CUBIC)


def lines(seen: Seen) -> list[str]:
    """The prediction rate, the latency, the contact state and the remark on the image source, as lines of text."""
    predicted = seen.predicted
    latency = "" if seen.latency_s is None else f"latency {1000 * seen.latency_s:.0f} ms"
    touch = "contact unknown"
    if predicted is not None and predicted.contact is not None:
        touch = "contact" if predicted.contact else "no contact" if predicted.occupied else "nothing on the pad"
    return [line for line in (f"{seen.rate:.1f} predictions/s", latency, touch, *seen.note.split(", ")) if line]


def panel(seen: Seen) -> Image:
    """Draw the live and the predicted images, the outcome probabilities, the rate and the latency in one row."""
    predicted = seen.predicted
    images = [seen.visual, seen.tactile, *([] if predicted is None else [predicted.visual, predicted.tactile])]
    sheet = Pictures.new("RGB", (4 * (_SMALL + _GAP) + _TEXT, _HEAD + _SMALL + _GAP), "white")
    pen, font = ImageDraw.Draw(sheet), ImageFont.load_default(size=14)
    for column, (title, image) in enumerate(zip(_TITLES, images, strict=False)):
        left = column * (_SMALL + _GAP)
        pen.text((left + 2, 3), title, fill="black", font=font)
        small = cv2.resize(image, (_SMALL, _SMALL), interpolation=cv2.INTER_AREA)
        sheet.paste(Pictures.fromarray(small), (left, _HEAD))
    left, top = 4 * (_SMALL + _GAP), _HEAD
    for line in lines(seen):
        pen.text((left, top), line, fill="black", font=font)
        top += 20
    for name, chance in [] if predicted is None else predicted.outcomes:
        pen.text((left, top + 4), f"{name}  {chance:.0%}", fill="black", font=font)
        pen.rectangle((left, top + 24, left + 200, top + 32), outline="#bbb")
        pen.rectangle((left, top + 24, left + round(200 * chance), top + 32), fill=_BAR)
        top += 36
    return np.asarray(sheet)
