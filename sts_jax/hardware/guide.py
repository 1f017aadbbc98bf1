"""The states through which a person is guided in one trajectory: a pure function of images and time, without devices.

An object is placed on the pad and held (`PLACE`, `HOLD`), released (`RELEASE`), and left until it rests (`STILL`). All
decisions use the means of blocks (24 rows of 32), so that noise of single pixels hardly counts, and thresholds that
follow the noise of these means on the empty pad.
"""

import dataclasses
import enum
import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float, UInt8

from sts_jax.hardware.settling import thumbnail

Blocks = Float[np.ndarray, "24 32 3"]  # means of an image's blocks, 0 to 255
End = Literal["initial", "final"]

_NORMAL = 1.4826  # standard deviation of a normal distribution over its median absolute deviation
_KEPT = 16  # newest pairs of a window that are kept


class Stage(enum.Enum):
    """What the person has to do."""

    CLEAR = "clear"  # take everything off the pad
    PLACE = "place"  # place the object on the pad
    HOLD = "hold"  # hold it still
    RELEASE = "release"  # release it
    STILL = "still"  # wait until it rests
    REVIEW = "review"  # confirm or discard the trajectory


@dataclasses.dataclass(frozen=True)
class GuideConfig:
    """Thresholds and times of the guide.

    Raises:
        ValueError: a value is out of range.
    """

    deviations: float = 6.0  # standard deviations of a block's mean by which a change exceeds the noise
    smallest_change: float = 3.0  # of 255, change of a block below which nothing counts, however low the noise is
    largest_threshold: float = 24.0  # of 255, to which the noise may raise the threshold
    contact_blocks: int = 3  # blocks of the tactile image that differ from the empty pad in a contact
    watched: Literal["both", "tactile"] = "both"  # streams in which a movement counts
    empty_s: float = 0.5  # s without movement after which the pad counts as empty
    hold_s: float = 0.5  # s without movement before the initial pair is taken
    rest_s: float = 1.0  # s without movement before the final pair is taken
    pairs: int = 4  # smallest number of pairs in each of these times
    hint_s: float = 10.0  # s in one stage after which a hint is shown

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if field.name != "watched" and not (value > 0 and math.isfinite(value)):
                raise ValueError(f"{field.name} must be > 0 and finite, got {value}")
        if self.watched not in ("both", "tactile"):
            raise ValueError(f"watched must be 'both' or 'tactile', got {self.watched!r}")
        if self.pairs < 3:  # the pair that is taken lies between two others
            raise ValueError(f"pairs must be >= 3, got {self.pairs}")
        if self.largest_threshold < self.smallest_change:
            raise ValueError(
                f"largest_threshold must be at least smallest_change ({self.smallest_change:g}), got "
                f"{self.largest_threshold:g}"
            )


class Observation(NamedTuple):
    """A pair of images, reduced to block means."""

    time_s: float  # arrival of the later image, on any clock that increases (s)
    visual: Blocks
    tactile: Blocks


@dataclasses.dataclass(frozen=True, eq=False)
class EmptyPad:
    """Block means of the pad without an object, and the standard deviations of their noise."""

    visual: Blocks
    tactile: Blocks
    visual_noise: Blocks
    tactile_noise: Blocks


@dataclasses.dataclass(frozen=True, eq=False)
class State:
    """State of the guide. Start with `start`."""

    stage: Stage
    since_s: float | None  # time of the first observation in this stage (s), None: there was none
    now_s: float | None  # time of the last observation (s)
    empty: EmptyPad | None  # None: not known yet
    trusted: bool  # whether the pad is known to be empty in the stage CLEAR
    contact: bool  # whether the tactile image of the last observation shows a contact
    still: bool  # whether the last observation differs in nothing from the first one of the window
    window: tuple[Observation, ...]  # since the last movement: the first observation and the newest ones
    count: int  # observations in the window, with those that are no longer kept
    initial: Observation | None  # the initial pair of the current trajectory


def observe(
    time_s: float, visual: UInt8[np.ndarray, "height width 3"], tactile: UInt8[np.ndarray, "height width 3"]
) -> Observation:
    """Reduce a pair of images to block means.

    Args:
        time_s: arrival of the later image (s).
        visual: RGB image.
        tactile: RGB image.
    """
    return Observation(time_s, thumbnail(visual), thumbnail(tactile))


def empty_pad(observations: Sequence[Observation]) -> EmptyPad:
    """Measure the empty pad from observations at rest.

    A block's noise is its own standard deviation, but at least the median one of its stream, because few observations
    can underestimate it.

    Raises:
        ValueError: there are fewer than two observations.
    """
    if len(observations) < 2:
        raise ValueError(f"at least 2 observations are needed to measure the noise, got {len(observations)}")
    visual, tactile = (
        np.stack(looks) for looks in ([o.visual for o in observations], [o.tactile for o in observations])
    )
    return EmptyPad(visual.mean(0), tactile.mean(0), _noise(visual), _noise(tactile))


def _noise(looks: Float[np.ndarray, "n 24 32 3"]) -> Blocks:
    deviation = looks.std(0, ddof=1)
    return np.maximum(deviation, np.median(deviation)).astype(np.float32)


def known_pad(visual: UInt8[np.ndarray, "height width 3"], tactile: UInt8[np.ndarray, "height width 3"]) -> EmptyPad:
    """The empty pad from the background images of a sensor file, before its noise is measured."""
    none = np.zeros_like(thumbnail(visual))
    return EmptyPad(thumbnail(visual), thumbnail(tactile), none, none)


def start(empty: EmptyPad | None = None, *, trusted: bool = False) -> State:
    """The state before the first trajectory.

    Args:
        empty: the empty pad, if it is known.
        trusted: whether the pad is empty now. Without that, and if `empty` is None, the guide waits for `confirm`.
    """
    return State(Stage.CLEAR, None, None, empty, trusted, False, False, (), 0, None)


def step(config: GuideConfig, state: State, observation: Observation) -> tuple[State, End | None]:
    """Advance the guide by one observation.

    Returns:
        The new state, and the end of the trajectory that was reached. The pair of that end is the one before this
        observation: it lies between others that are equal to it, so nothing moved while it was taken.
    """
    moved = not state.window or not _same(config, state, state.window[0], observation)
    window = (observation,) if moved else (state.window[0], *state.window[1:][-_KEPT:], observation)
    state = dataclasses.replace(
        state,
        since_s=observation.time_s if state.since_s is None else state.since_s,
        now_s=observation.time_s,
        contact=state.empty is not None and has_contact(config, state.empty, observation),
        still=not moved,
        window=window,
        count=1 if moved else state.count + 1,
    )
    match state.stage:
        case Stage.CLEAR:
            return _clear(config, state), None
        case Stage.PLACE if state.contact:
            return _enter(state, Stage.HOLD), None
        case Stage.HOLD if not state.contact:
            return _enter(state, Stage.PLACE), None
        case Stage.HOLD if _rested(config, state, config.hold_s):
            return dataclasses.replace(_enter(state, Stage.RELEASE), initial=window[-2]), "initial"
        case Stage.RELEASE if state.initial is not None and not _same(config, state, state.initial, observation):
            return _enter(state, Stage.STILL), None
        case Stage.STILL if _rested(config, state, config.rest_s):
            return _enter(state, Stage.REVIEW), "final"
    return state, None


def _clear(config: GuideConfig, state: State) -> State:
    """The stage `CLEAR`: the empty pad is measured anew each time, so that it follows slow changes of the light."""
    if state.empty is None and not state.trusted:
        return state
    if (state.contact and not state.trusted) or not _rested(config, state, config.empty_s):
        return state
    return dataclasses.replace(_enter(state, Stage.PLACE), empty=empty_pad(state.window), trusted=False)


def confirm(state: State) -> State:
    """The person confirms: the pad is empty (`CLEAR`), the object is released (`RELEASE`), or the trajectory is good.

    In the other stages nothing changes.
    """
    match state.stage:
        case Stage.CLEAR:
            return dataclasses.replace(state, trusted=True, window=(), count=0)
        case Stage.RELEASE:
            return _enter(state, Stage.STILL)
        case Stage.REVIEW:
            return _enter(state, Stage.CLEAR)
    return state


def discard(state: State) -> State:
    """The person discards the current trajectory. Before the object is placed, nothing changes."""
    return state if state.stage in (Stage.CLEAR, Stage.PLACE) else _enter(state, Stage.CLEAR)


def interrupted(state: State) -> State:
    """The devices were interrupted, so rest has to be observed anew."""
    return dataclasses.replace(state, window=(), count=0, still=False)


def _enter(state: State, stage: Stage) -> State:
    initial = None if stage in (Stage.CLEAR, Stage.PLACE) else state.initial
    return dataclasses.replace(state, stage=stage, since_s=state.now_s, window=(), count=0, initial=initial)


def has_contact(config: GuideConfig, empty: EmptyPad, observation: Observation) -> bool:
    """Whether the tactile image shows a contact.

    The median difference of all blocks is subtracted, so that a change of the light as a whole is no contact.
    """
    change = observation.tactile - empty.tactile
    change = change - np.median(change, axis=(0, 1))
    noise = empty.tactile_noise * math.sqrt(1 + 1 / config.pairs)  # that of the mean over the empty pad comes on top
    return int((np.abs(change) > _threshold(config, noise)).any(-1).sum()) >= config.contact_blocks


def _same(config: GuideConfig, state: State, first: Observation, second: Observation) -> bool:
    """Whether two observations show no movement."""
    streams: tuple[Literal["visual", "tactile"], ...] = ("visual", "tactile")
    for stream in streams if config.watched == "both" else streams[1:]:
        one, two = getattr(first, stream), getattr(second, stream)
        if state.empty is None:
            # A small object in motion leaves the median unchanged.
            recent = [getattr(seen, stream) for seen in (*state.window[-4:], second)]
            noise = _NORMAL * np.median(np.abs(np.diff(recent, axis=0))) / math.sqrt(2)
        else:
            noise = getattr(state.empty, f"{stream}_noise")
        if (np.abs(two - one) > _threshold(config, math.sqrt(2) * noise)).any():
            return False
    return True


def _threshold(config: GuideConfig, noise: Blocks | float | np.floating) -> Blocks | np.floating:
    return np.clip(config.deviations * np.asarray(noise), config.smallest_change, config.largest_threshold)


def _rested(config: GuideConfig, state: State, least_s: float) -> bool:
    return state.count >= config.pairs and state.window[-1].time_s - state.window[0].time_s >= least_s


_INSTRUCTIONS = {
    Stage.CLEAR: "Take everything off the pad and out of view.",
    Stage.PLACE: "Place the object on the pad in an unstable pose, and keep holding it.",
    Stage.HOLD: "Hold the object still.",
    Stage.RELEASE: "Release the object, and take your hand out of view.",
    Stage.STILL: "Wait until nothing moves.",
    Stage.REVIEW: "Confirm or discard this trajectory.",
}
_HINTS = {
    Stage.CLEAR: "If the pad is empty, confirm, and it is measured again.",
    Stage.PLACE: "If the object lies on the pad, press it harder. The tactile image shows no contact yet.",
    Stage.HOLD: "The image still changes. Rest your hand on the edge of the pad.",
    Stage.RELEASE: "If the object stays where it was, confirm.",
    Stage.STILL: "The image still changes. Check that nobody is in view and that the room's light is steady.",
}


def instruction(config: GuideConfig, state: State) -> str:
    """One or two sentences for the person."""
    if state.stage is Stage.CLEAR and state.empty is None and not state.trusted:
        return f"{_INSTRUCTIONS[Stage.CLEAR]} Then confirm."
    late = state.now_s is not None and state.since_s is not None and state.now_s - state.since_s >= config.hint_s
    hint = _HINTS.get(state.stage) if late else None
    return _INSTRUCTIONS[state.stage] if hint is None else f"{_INSTRUCTIONS[state.stage]} {hint}"
