"""Predictions of the resting state from live images, in a thread that leaves out images rather than falling behind."""

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

import sts_jax as sts
from sts_jax import hardware
from sts_jax.hardware import guide

SIDE = 384  # pixels, of the images that are shown
_RECENT_S = 3.0  # s, over which the rate is measured
_KEPT = 4096  # latencies that are kept for the median
_OCCUPIED = 8.0  # of 255, change of a block of the visual image that shows an object
_BLOCKS = 3  # such blocks

Image = UInt8[np.ndarray, "height width 3"]


@dataclasses.dataclass(frozen=True, eq=False)
class Predicted:
    """A prediction and the images that it was made from."""

    visual: Image  # at rest, the mean over the model's samples
    tactile: Image
    outcomes: list[tuple[str, float]]  # names and probabilities, empty for a model without
    contact: bool | None  # whether the object touches the pad now. None: there is no background to compare with
    occupied: bool | None  # whether there is an object. None: there is no background to compare with
    newest_s: float  # arrival of the newer one of its images, on `time.monotonic` (s)


class Seen(NamedTuple):
    """All that is shown at one moment."""

    visual: Image  # newest image, in the view of the sensor
    tactile: Image
    time_s: float  # arrival of the newest image, on `time.monotonic` (s)
    images_per_s: float
    predicted: Predicted | None
    rate: float  # predictions per second
    latency_s: float | None  # median, from the arrival of the newer image until the prediction is shown
    recorded: int | None  # images in the recording. None: there is none
    note: str  # on the source


@dataclasses.dataclass(frozen=True, eq=False)
class Backgrounds:
    """The raw images of the empty pad."""

    visual: Image
    tactile: Image
    divided: bool  # whether the images for the model are divided by them


@dataclasses.dataclass(frozen=True, eq=False)
class Views:
    """The way from raw images to the view of the sensor."""

    lens: hardware.Lens
    pinhole: hardware.Pinhole
    backgrounds: Backgrounds | None

    def shown(self, image: Image) -> Image:
        """The view of a raw image, for people."""
        return hardware.rectified(self.lens, self.pinhole, image, (SIDE, SIDE))

    def floats(self, image: Image, resolution: tuple[int, int]) -> Float[np.ndarray, "height width 3"]:
        """The view of a raw image, for a model, [0, 1]."""
        return hardware.rectified(self.lens, self.pinhole, image, resolution).astype(np.float32) / 255

    def prepared(self, visual: Image, tactile: Image, empty: Mapping[str, np.ndarray]) -> hardware.SensorView:
        """Raw images as a model takes them, in the light of its untouched sensor.

        Args:
            visual: Raw image.
            tactile: Raw image.
            empty: The images of the untouched sensor, `Predictor.empty`.
        """
        model = hardware.SensorView(**empty)
        rows, columns = model.visual.shape[:2]
        size, empty_pad = (rows, columns), self.backgrounds
        view = hardware.SensorView(self.floats(visual, size), self.floats(tactile, size))
        if empty_pad is None or not empty_pad.divided:
            return view
        background = hardware.SensorView(self.floats(empty_pad.visual, size), self.floats(empty_pad.tactile, size))
        return hardware.relit(view, background, model)


class Live:
    """Predicts in a thread of its own, always from the newest images.

    ```python
    with Live(predictor, views, names, (), show) as live:
        live.offer(visual, tactile)
        live.newest
    ```
    """

    def __init__(
        self,
        predictor: sts.Predictor,
        views: Views,
        outcomes: tuple[str, ...],
        condition: tuple[float, ...],
        show: Callable[[], None],
    ):
        """Compile the prediction, which takes about half a minute at the first time on a machine, and start.

        Args:
            predictor: The model. It has to take visual images.
            views: The way from raw images to its view.
            outcomes: Names of the outcomes of its scenario, in their order.
            condition: Its condition, in SI units. Empty: zeros.
            show: Called in the thread after each prediction. The latency ends when it returns.

        Raises:
            ValueError: The model takes no visual images, or needs another condition.
        """
        if "visual" not in predictor.modalities:
            raise ValueError(f"{predictor!r} takes no visual images: give another --model")
        width = predictor.model.config.condition
        if len(condition) not in (0, width):
            raise ValueError(f"condition has {len(condition)} numbers, but {predictor!r} needs {width}")
        self._predictor, self._views, self._outcomes = predictor, views, outcomes
        self._condition = np.asarray(condition or (0.0,) * width, np.float32) if width else None
        self._show = show
        self._streams = tuple(name for name in ("visual", "tactile") if name in predictor.modalities)
        self._untouched = predictor.empty
        empty = views.backgrounds
        self._empty = None if empty is None else hardware.known_pad(empty.visual, empty.tactile)
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
        """Predict from these images next. Images that were offered before and not yet taken are left out.

        Raises:
            Exception: The error that has ended the thread.
        """
        with self._changed:
            if self._error is not None:
                raise self._error
            self._next = visual, tactile
            self.offered += 1
            self._changed.notify_all()

    @property
    def newest(self) -> Predicted | None:
        """The newest prediction."""
        with self._changed:
            return self._newest

    @property
    def rate(self) -> float:
        """Predictions per second, of the last three seconds."""
        now_s = time.monotonic()
        with self._changed:
            recent = [shown_s for shown_s in self._shown_s if shown_s > now_s - _RECENT_S]
        return (len(recent) - 1) / (recent[-1] - recent[0]) if len(recent) > 1 else 0.0

    @property
    def latency_s(self) -> float | None:
        """Median time from the arrival of the newer image of a prediction until it is shown (s)."""
        with self._changed:
            return statistics.median(self._latencies_s) if self._latencies_s else None

    def close(self) -> None:
        """End the thread."""
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
        except Exception as error:  # raised by the next call of `offer`
            with self._changed:
                self._error = error

    def _taken(self) -> tuple[hardware.Shot, hardware.Shot] | None:
        with self._changed:
            self._changed.wait_for(lambda: self._stopped or self._next is not None)
            shots, self._next = self._next, None
            return None if self._stopped else shots

    def _predict(self, visual: hardware.Shot, tactile: hardware.Shot) -> Predicted:
        contact, occupied = self._contact(visual, tactile)
        view = self._views.prepared(visual.image, tactile.image, self._untouched)
        found = self._compute(view._asdict(), contact=contact is not False)
        names = self._outcomes
        chances = [] if found.outcome_probability is None else np.asarray(found.outcome_probability).tolist()
        if len(names) != len(chances):
            names = tuple(f"outcome {number}" for number in range(len(chances)))
        return Predicted(
            _shown(found.visual),
            _shown(found.tactile),
            list(zip(names, chances, strict=True)),
            contact,
            occupied,
            max(visual.time_s, tactile.time_s),
        )

    def _compute(self, views: Mapping[str, np.ndarray], *, contact: bool) -> sts.Prediction:
        """Predict, and wait for the result. A touch without contact does not count."""
        touch = views["tactile"] if "tactile" in self._streams else None
        present: dict[str, ArrayLike] | None = None if touch is None else {"tactile": np.bool_(contact)}
        found = self._predictor(visual=views["visual"], tactile=touch, condition=self._condition, present=present)
        return jax.block_until_ready(found)

    def _contact(self, visual: hardware.Shot, tactile: hardware.Shot) -> tuple[bool | None, bool | None]:
        """Whether the tactile image shows a contact, and whether any of both shows an object."""
        if self._empty is None:
            return None, None
        observation = guide.observe(tactile.time_s, visual.image, tactile.image)
        contact = guide.has_contact(hardware.GuideConfig(), self._empty, observation)
        change = np.abs(observation.visual - self._empty.visual).max(-1)
        return contact, contact or int((change > _OCCUPIED).sum()) >= _BLOCKS


def _shown(image: Float[Array, "height width 3"] | None) -> Image:
    """A predicted image for people."""
    pixels = np.zeros((1, 1, 3)) if image is None else np.asarray(jnp.clip(image, 0, 1))
    return cv2.resize(np.round(255 * pixels).astype(np.uint8), (SIDE, SIDE), interpolation=cv2.INTER_CUBIC)
