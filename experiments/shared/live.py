"""Predicts images of the resting object from live images in a thread, and draws what a live display shows.

Live images that arrive while the model is busy are skipped, and never queued.
"""

import collections
import dataclasses
import os
import statistics
import threading
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

import cv2
import jax
import numpy as np
from jaxtyping import Array, ArrayLike, Float, UInt8

import sts_jax as sts
from experiments.shared.device import TwinHand
from sts_jax import geometry, hardware, optics
from sts_jax.hardware import Stage, collecting

SIDE = 384  # side of the images that are shown (pixels)
_RECENT = 400  # number of predictions from which their rate and latency are computed
_OCCUPIED = 8.0  # difference of a block of the visual image from the empty pad that counts as a change, of 255
_BLOCKS = 3  # number of changed blocks that show an object

_DRAWN = 16  # number of sampled images, whose mean is the predicted image
_SAMPLES = 4  # number of samples that are shown
_GAP = 4  # distance between two samples (pixels)
_GUIDE = hardware.GuideConfig()  # thresholds of contact and movement

_TINT = 0.15  # opacity of a predicted outline's area
_COLOUR = 255, 130, 0  # colour of the predicted outlines
_SMALL = 240  # side of an image in a panel (pixels)
_MEAN = 88  # side of a mean image in a panel (pixels)
_LINE = 23  # height of a line of text (pixels)

Image = UInt8[np.ndarray, "height width 3"]
Outline = Sequence[np.ndarray]  # closed lines around an area and around its holes, each (n, 1, 2) pixels


class Predicted(NamedTuple):
    """A prediction of the resting state, and facts about the input images and about all predictions."""

    visual: Image  # predicted visual image at rest, the mean over the model's samples
    tactile: Image  # predicted tactile image at rest
    samples_visual: Image  # four samples of the visual image at rest, as one image
    samples_tactile: Image  # four samples of the tactile image at rest
    outcomes: list[tuple[str, float]]  # names and probabilities of the outcomes, empty if the model predicts none
    contact: bool  # True if the object touches the pad now
    occupied: bool  # True if an object is in view
    resting: bool  # True if the object has come to rest. All images are then those of the present
    time_s: float  # arrival of the older one of the two input images, on the clock `time.monotonic` (s)
    pose: Float[np.ndarray, "7"] | None = None  # predicted pose, the centre of all samples
    outlines: tuple[Outline, ...] = ()  # outlines of the body in the visual image, at the sampled poses
    rate: float = 0.0  # predictions per second
    latency_ms: float = 0.0  # median time from the arrival of an input's newer image until its prediction is made (ms)

    def lines(self) -> list[str]:
        """The rate, the latency, the contact and the outcomes, as lines of text."""
        touch = "contact" if self.contact else "no contact" if self.occupied else "nothing on the pad"
        touch = "at rest" if self.resting else touch
        outcomes = (f"{name} {chance:.2f}" for name, chance in self.outcomes)
        return [f"{self.rate:.1f} predictions/s", f"latency {self.latency_ms:.0f} ms", touch, *outcomes]


class Seen(NamedTuple):
    """All content of the live display at one time."""

    visual: Image  # newest visual image, in the view of the sensor, with the predicted outlines of a known body
    tactile: Image  # newest tactile image, in the view of the sensor
    time_s: float  # arrival of the newest image, on the clock `time.monotonic` (s)
    predicted: Predicted | None  # newest prediction, or None before the first one


def panel(seen: Seen) -> Image:
    """Draw the live images, four samples of each stream, the mean images and the lines of text in one row."""
    found = seen.predicted
    assert found is not None
    text = np.full((_SMALL, _SMALL, 3), 255, np.uint8)
    for number, line in enumerate(found.lines(), 1):
        cv2.putText(text, line, (8, number * _LINE), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 0), 1, cv2.LINE_AA)
    for number, image in enumerate((found.visual, found.tactile)):
        left = 8 + number * (_MEAN + 8)
        text[-_MEAN:, left : left + _MEAN] = cv2.resize(image, (_MEAN, _MEAN), interpolation=cv2.INTER_AREA)
    images = seen.visual, seen.tactile, found.samples_visual, found.samples_tactile
    small = [cv2.resize(image, (_SMALL, _SMALL), interpolation=cv2.INTER_AREA) for image in images]
    return np.hstack([*small, text])


def outlines(body: sts.objects.Body, poses: Float[np.ndarray, "n 7"], pinhole: optics.Camera) -> tuple[Outline, ...]:
    """Outlines of a body in the visual image, as shown, at some poses. A pose that is out of view has none.

    The gel is not modelled: rays are straight lines through the pinhole.
    """
    found = list[Outline]()
    for pixels, depth in zip(*map(np.asarray, _projected(body.vertices, poses, pinhole)), strict=True):
        if depth.min() < pinhole.near:  # below the pad
            continue
        triangles, area = pixels[np.asarray(body.faces)], np.zeros((SIDE, SIDE), np.uint8)
        (x1, y1), (x2, y2) = (np.moveaxis(triangles[:, corner] - triangles[:, 0], -1, 0) for corner in (1, 2))
        seen = x1 * y2 - x2 * y1 < 0  # the surface is closed, so the faces towards the pinhole cover the whole area
        for triangle in triangles[seen | body.two_sided].round().astype(np.int32):
            cv2.fillConvexPoly(area, triangle, 255)
        found.append(cv2.findContours(area, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)[0])
    return tuple(found)


@jax.jit
def _projected(
    vertices: Float[Array, "v 3"], poses: Float[Array, "n 7"], pinhole: optics.Camera
) -> tuple[Float[Array, "n v 2"], Float[Array, "n v"]]:
    """Pixels and depths of vertices at some poses."""
    window = optics.full_window(pinhole, (SIDE, SIDE))
    return jax.vmap(lambda pose: optics.to_pixels(pinhole, window, (SIDE, SIDE), geometry.transform(pose, vertices)))(
        poses
    )


def outlined(image: Image, outlines: tuple[Outline, ...]) -> Image:
    """Draw outlines over an image, and tint their areas."""
    if not outlines:
        return image
    tinted = image.copy()
    for outline in outlines:
        cv2.drawContours(tinted, outline, -1, _COLOUR, cv2.FILLED)
    drawn = cv2.addWeighted(image, 1 - _TINT, tinted, _TINT, 0)
    for outline in outlines:
        cv2.drawContours(drawn, outline, -1, _COLOUR, 1, cv2.LINE_AA)
    return drawn


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


def check_model(predictor: sts.Predictor, condition: Sequence[float]) -> int:
    """Check that a model sees and has a condition of this length, or that none is given. Returns its true length."""
    if "visual" not in predictor.modalities:
        raise ValueError(f"--model must take visual images as inputs: give another one than {predictor!r}")
    width = predictor.model.config.condition
    if len(condition) not in (0, width):
        raise ValueError(f"--condition must have {width} values, got {len(condition)}, for {predictor!r}")
    return width


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
        width = check_model(predictor, condition)
        self._predictor, self.views = predictor, views
        self._condition = np.asarray(condition or (0.0,) * width, np.float32) if width else None
        self._untouched = predictor.empty
        self._touches = "tactile" in predictor.modalities
        self._empty = hardware.known_pad(*views.empty)
        # An object that is held touches the pad and is still, too. A model that takes touch therefore waits for a
        # release. A model that takes none predicts from objects in the air.
        self._begin = collecting.State(Stage.PLACE if self._touches else Stage.STILL, empty=self._empty)
        self._guide = self._begin
        self.body: sts.objects.Body | None = None  # the body in view, whose predicted outlines are drawn
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

    @property
    def summary(self) -> str:
        """Number, rate and latency of the predictions."""
        rate, latency_ms = (0.0, 0.0) if self.newest is None else (self.newest.rate, self.newest.latency_ms)
        return (
            f"{self.made} predictions, {rate:.1f} per second, median latency {latency_ms:.0f} ms, "
            f"{self.offered - self.made} images without a prediction of their own"
        )

    def _rests(self, observation: collecting.Observation) -> bool:
        """Whether the object has come to rest, by the guide of the collection (docs/hardware/collecting.md)."""
        before = self._guide
        self._guide, _ = collecting.step(_GUIDE, before, observation)
        if self._guide.stage is not Stage.REVIEW:
            return False
        moved = before.stage is Stage.REVIEW and len(before.window) > 0 and not self._guide.still
        if moved or not self._guide.contact:
            self._guide = dataclasses.replace(self._begin, contact=self._guide.contact)
        return self._guide.stage is Stage.REVIEW

    def _predict(self, visual: hardware.Shot, tactile: hardware.Shot) -> Predicted:
        """Predict from raw images, unless the object is at rest."""
        time_s = min(visual.time_s, tactile.time_s)
        observation = collecting.observe(max(visual.time_s, tactile.time_s), visual.image, tactile.image)
        resting, contact = self._rests(observation), self._guide.contact
        if resting:
            seen, felt = self.views.shown(visual.image), self.views.shown(tactile.image)
            return Predicted(seen, felt, seen, felt, [], contact, occupied=True, resting=True, time_s=time_s)
        change = np.abs(observation.visual - self._empty.mean.visual).max(-1)
        occupied = contact or int((change > _OCCUPIED).sum()) >= _BLOCKS
        view = self.views.prepared(visual.image, tactile.image, self._untouched)
        out = self._compute(view._asdict(), occupied=occupied, contact=contact)
        chances = [] if out.outcome_probability is None else np.asarray(out.outcome_probability).tolist()
        names = self._predictor.outcomes or tuple(f"outcome {number}" for number in range(len(chances)))
        outcomes = list(zip(names, chances, strict=True))
        assert out.samples is not None
        samples = _mosaic(out.samples.visual), _mosaic(out.samples.tactile)
        found = Predicted(
            _shown(out.visual), _shown(out.tactile), *samples, outcomes, contact, occupied, resting=False, time_s=time_s
        )
        if not occupied or out.pose is None or self.body is None:
            return found
        poses = np.asarray(out.samples.pose)[:_SAMPLES]
        return found._replace(pose=np.asarray(out.pose), outlines=outlines(self.body, poses, self.views.pinhole))

    def _compute(self, views: Mapping[str, np.ndarray], *, occupied: bool, contact: bool) -> sts.Prediction:
        """Predict from images in the view of the sensor. An image of the empty pad or without contact is ignored."""
        touch = views["tactile"] if self._touches else None
        present: dict[str, ArrayLike] = {"visual": np.bool_(occupied)}
        if touch is not None:
            present["tactile"] = np.bool_(contact)
        out = self._predictor(
            visual=views["visual"],
            tactile=touch,
            condition=self._condition,
            present=present,
            key=jax.random.key(0),  # always the same, so that the samples change with the images only
            num_samples=_DRAWN,
        )
        return jax.block_until_ready(out)


def follow(live: Live, shots: Iterable[hardware.Shot], hand: TwinHand | None = None) -> Iterator[Seen]:
    """Pass the newest images to `live`, and yield what a display shows after each of them.

    While the object of `hand` moves and when it has come to rest, the prediction before its release stays.
    """
    newest, shown = dict[str, hardware.Shot](), dict[str, Image]()
    for shot in shots:
        newest[shot.stream], shown[shot.stream] = shot, live.views.shown(shot.image)
        if len(newest) < 2:
            continue
        if hand is not None:
            live.body = hand.body
        if hand is None or not hand.let_go:
            live.offer(**newest)
        found = live.newest
        visual = outlined(shown["visual"], () if found is None else found.outlines)
        yield Seen(visual, shown["tactile"], shot.time_s, found)


def _shown(image: Float[Array | np.ndarray, "height width 3"] | None, side: int = SIDE) -> Image:
    """Convert a predicted image in [0, 1] to uint8 of (side, side) pixels. None becomes a black image."""
    pixels = np.zeros((1, 1, 3)) if image is None else np.clip(np.asarray(image), 0, 1)
    return cv2.resize(np.round(255 * pixels).astype(np.uint8), (side, side), interpolation=cv2.INTER_CUBIC)


def _mosaic(images: Float[Array, "n height width 3"] | None) -> Image:
    """The first four images in two rows, in the size for display. None becomes a black image."""
    if images is None:
        return _shown(None)
    side, mosaic = (SIDE - _GAP) // 2, np.full((SIDE, SIDE, 3), 255, np.uint8)
    for number, image in enumerate(np.asarray(images)[:_SAMPLES]):
        top, left = (index * (side + _GAP) for index in divmod(number, 2))
        mosaic[top : top + side, left : left + side] = _shown(image, side)
    return mosaic
