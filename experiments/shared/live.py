"""A thread that predicts images of the resting object from live images. A slow model skips some live images."""

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

SIDE = 384  # side of the images that are shown (pixels)
_RECENT_S = 3.0  # time over which the rate is measured (s)
_KEPT = 4096  # number of latencies from which the median is computed
_OCCUPIED = 8.0  # difference of a block of the visual image from the empty pad that counts as a change, of 255
_BLOCKS = 3  # number of changed blocks that show an object

Image = UInt8[np.ndarray, "height width 3"]


@dataclasses.dataclass(frozen=True, eq=False)
class Predicted:
    """A prediction of the resting state, and facts about the input images, such as whether they show a contact."""

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
class Backgrounds:
    """The raw images of the empty pad."""

    visual: Image  # raw image without light
    tactile: Image  # raw image with light
    divided: bool  # True if the images for the model are divided by the images of the empty pad


@dataclasses.dataclass(frozen=True, eq=False)
class Views:
    """The conversion from raw images to rectified images, which show the view of the sensor's pinhole camera."""

    lens: hardware.Lens  # lens of the raw images
    pinhole: sts.optics.Camera  # view of the sensor
    backgrounds: Backgrounds | None  # images of the empty pad, if they are known

    def shown(self, image: Image) -> Image:
        """Rectify a raw image for display, and crop it to the sensor's pad.

        Args:
            image: Raw image, uint8 RGB.

        Returns:
            Rectified image, uint8 RGB of shape (SIDE, SIDE, 3).
        """
        return hardware.rectified(self.lens, self.pinhole, image, (SIDE, SIDE))

    def floats(self, image: Image, resolution: tuple[int, int]) -> Float[np.ndarray, "height width 3"]:
        """Rectify a raw image, and crop it to the sensor's pad.

        Args:
            image: Raw image, uint8 RGB.
            resolution: Height and width of the result (pixels).

        Returns:
            Rectified image, float32 RGB in [0, 1].
        """
        return hardware.rectified(self.lens, self.pinhole, image, resolution).astype(np.float32) / 255

    def prepared(self, visual: Image, tactile: Image, empty: Mapping[str, np.ndarray]) -> hardware.SensorView:
        """Convert raw images to the inputs of a model.

        If `self.backgrounds` is not None and `self.backgrounds.divided` is True, `hardware.relit` adapts the brightness
        and the colours of the images to the sensor on which the model was trained.

        Args:
            visual: Raw visual image.
            tactile: Raw tactile image.
            empty: Images of the empty pad of the sensor on which the model was trained (`Predictor.empty`). The result
                has the same resolution as these images.
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
        """Compile the model, and start the thread.

        The first compilation on a machine takes about half a minute.

        Args:
            predictor: Trained model. Visual images must be among its inputs.
            views: Conversion from raw images to the view of the sensor.
            condition: Known quantities of the scenario that the model receives (SI units). An empty tuple stands for
                zeros.
            show: Function that the thread calls after each prediction. The latency includes this call.

        Raises:
            ValueError: The model cannot use visual images, or `condition` has the wrong length.
        """
        if "visual" not in predictor.modalities:
            raise ValueError(
                f"the model takes no visual images as inputs: give another --model. The model is {predictor!r}"
            )
        width = predictor.model.config.condition
        if len(condition) not in (0, width):
            raise ValueError(
                f"the number of values of --condition must be {width}, got {len(condition)}: change this option, or "
                f"leave it out. The model is {predictor!r}"
            )
        self._predictor, self._views = predictor, views
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
        """Pass new images to the prediction thread. They replace earlier images that the thread has not used yet.

        Args:
            visual: Newest visual image.
            tactile: Newest tactile image.

        Raises:
            Exception: An earlier prediction raised this exception, which ended the thread.
        """
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
        """Median latency of the predictions (s), or None before the first prediction.

        The latency is the time from the arrival of the newer of the two input images until the prediction is shown.
        """
        with self._changed:
            return statistics.median(self._latencies_s) if self._latencies_s else None

    def close(self) -> None:
        """Stop the prediction thread."""
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
        found = self._compute(view._asdict(), contact=contact is not False)
        chances = [] if found.outcome_probability is None else np.asarray(found.outcome_probability).tolist()
        names = self._predictor.outcomes or tuple(f"outcome {number}" for number in range(len(chances)))
        return Predicted(
            _shown(found.visual),
            _shown(found.tactile),
            list(zip(names, chances, strict=True)),
            contact,
            occupied,
            max(visual.time_s, tactile.time_s),
        )

    def _compute(self, views: Mapping[str, np.ndarray], *, contact: bool) -> sts.Prediction:
        """Predict from images in the view of the sensor. The tactile image is ignored unless `contact` is True."""
        touch = views["tactile"] if "tactile" in self._streams else None
        present: dict[str, ArrayLike] | None = None if touch is None else {"tactile": np.bool_(contact)}
        found = self._predictor(visual=views["visual"], tactile=touch, condition=self._condition, present=present)
        return jax.block_until_ready(found)

    def _contact(self, visual: hardware.Shot, tactile: hardware.Shot) -> tuple[bool | None, bool | None]:
        """Return whether the object touches the pad, and whether one of the images shows an object."""
        if self._empty is None:
            return None, None
        observation = guide.observe(tactile.time_s, visual.image, tactile.image)
        contact = guide.has_contact(hardware.GuideConfig(), self._empty, observation)
        change = np.abs(observation.visual - self._empty.visual).max(-1)
        return contact, contact or int((change > _OCCUPIED).sum()) >= _BLOCKS


def _shown(image: Float[Array, "height width 3"] | None) -> Image:
    """Convert a predicted image in [0, 1] to uint8 in the size for display. None becomes a black image."""
    pixels = np.zeros((1, 1, 3)) if image is None else np.asarray(jnp.clip(image, 0, 1))
    return cv2.resize(np.round(255 * pixels).astype(np.uint8), (SIDE, SIDE), interpolation=cv2.INTER_CUBIC)
