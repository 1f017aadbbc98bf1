"""The guide: a state machine that leads a person through the stages of a trajectory, as a pure function of images.

A movement is a change of the mean colour of a block (24 rows of 32) between two images. A contact is a difference
between the mean colours of a small block (48 rows of 64, because a contact can be small) in the tactile image and in a
tactile image of the empty pad. Means are compared, because the noise of single pixels averages out in them. A change
counts if it exceeds a multiple of the noise of the mean, but at least 3 and at most 24 of 255.
"""

import dataclasses
import enum
import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from sts_jax.hardware.proof import thumbnail

Image = UInt8[np.ndarray, "height width 3"]
Blocks = Float[np.ndarray, "24 32 3"]  # means of an image's blocks, 0 to 255
SmallBlocks = Float[np.ndarray, "48 64 3"]  # means of blocks of half the width and height, 0 to 255
End = Literal["initial", "final"]  # "initial": the pair of the held object, "final": the pair of the object at rest

_NORMAL = 1.4826  # ratio of the standard deviation to the median absolute deviation of a normal distribution
_SMALL_BLOCKS = 64, 48  # numbers of columns and rows of the small blocks
_KEPT = 16  # number of earlier observations that are kept in `State.window` besides its first one


class Stage(enum.Enum):
    """The stages of recording one trajectory. Each stage is an instruction for the person."""

    CLEAR = "clear"  # take everything off the pad
    PLACE = "place"  # place the object on the pad
    HOLD = "hold"  # hold the object still
    RELEASE = "release"  # release the object
    STILL = "still"  # wait until the object rests
    REVIEW = "review"  # confirm or discard the trajectory


# The instruction of each stage, and the hint that is added if the stage takes long.
_WORDS = {
    Stage.CLEAR: (
        "Take everything off the pad and out of view.",
        "If the pad is empty, confirm, and it is measured again.",
    ),
    Stage.PLACE: (
        "Place the object on the pad in an unstable pose, and keep holding it.",
        "If the object lies on the pad, press it harder. The tactile image shows no contact yet.",
    ),
    Stage.HOLD: ("Hold the object still.", "The image still changes. Rest your hand on the edge of the pad."),
    Stage.RELEASE: (
        "Release the object, and take your hand out of view.",
        "If the object stays where it was, confirm.",
    ),
    Stage.STILL: (
        "Wait until nothing moves.",
        "The image still changes. Check that nobody is in view and that the room's light is steady.",
    ),
    Stage.REVIEW: ("Confirm or discard this trajectory.", ""),
}
_CONFIRMED = {Stage.RELEASE: Stage.STILL, Stage.REVIEW: Stage.CLEAR}  # the stage after the person has confirmed


@dataclasses.dataclass(frozen=True)
class GuideConfig:
    """Thresholds and times of the guide."""

    deviations: float = 6.0  # threshold of a block's change, in standard deviations of the noise of the block's mean
    smallest_change: float = 3.0  # lower limit of the threshold of a block's change, of 255
    largest_threshold: float = 24.0  # upper limit of the threshold of a block's change, of 255
    contact_blocks: int = 3  # least number of small blocks (48 rows of 64) that differ from the empty pad in a contact
    watched: Literal["both", "tactile"] = "both"  # streams in which movements are detected
    empty_s: float = 0.5  # time without movement after which the pad counts as empty (s)
    hold_s: float = 0.5  # time without movement before the initial pair is taken (s)
    rest_s: float = 1.0  # time without movement before the final pair is taken (s)
    pairs: int = 4  # least number of pairs of images in each of these times, at least 3
    hint_s: float = 10.0  # time in the same stage after which a hint is shown (s)

    def __post_init__(self) -> None:
        for name, value in dataclasses.asdict(self).items():
            if name != "watched" and not (value > 0 and math.isfinite(value)):
                raise ValueError(f"{name} must be > 0 and finite, got {value}")
        if self.pairs < 3:  # the pair that is saved needs a pair before it and a pair after it
            raise ValueError(f"pairs must be >= 3, got {self.pairs}")
        if self.largest_threshold < self.smallest_change:
            raise ValueError(
                f"largest_threshold must be >= smallest_change = {self.smallest_change:g}, got "
                f"{self.largest_threshold:g}"
            )


class Observation(NamedTuple):
    """Means of the blocks of a pair of images."""

    time_s: float  # arrival time of the later image, on any clock that increases (s)
    visual: Blocks
    tactile: Blocks
    imprint: SmallBlocks  # small blocks of the tactile image, in which contacts are detected


class EmptyPad(NamedTuple):
    """The appearance of the empty pad."""

    mean: Observation
    noise: Observation  # standard deviation of each block, 0: unknown


@dataclasses.dataclass(frozen=True, eq=False)
class State:
    """The state of the guide. The default is the first one."""

    stage: Stage = Stage.CLEAR
    since_s: float | None = None  # time of the first observation in this stage (s), None: there was none
    now_s: float | None = None  # time of the last observation (s), None: there was none
    empty: EmptyPad | None = None  # the empty pad, None: not known yet, and measured when `trusted`
    trusted: bool = False  # in the stage CLEAR: the person or the program has stated that the pad is empty
    contact: bool = False  # the last tactile image shows a contact
    still: bool = False  # nothing has moved between the first observation of the window and the last one
    window: tuple[Observation, ...] = ()  # observations since the last movement: the first one and the newest ones
    count: int = 0  # number of observations since the last movement, with the ones that are not kept in `window`
    initial: Observation | None = None  # observation of the initial pair, None: not taken yet


def observe(time_s: float, visual: Image, tactile: Image) -> Observation:
    """Average the blocks of a pair of raw images, whose later one arrived at `time_s` (s)."""
    imprint = cv2.resize(tactile, _SMALL_BLOCKS, interpolation=cv2.INTER_AREA).astype(np.float32)
    return Observation(time_s, thumbnail(visual), thumbnail(tactile), imprint)


def empty_pad(observations: Sequence[Observation]) -> EmptyPad:
    """Measure the empty pad and its noise from at least two observations without movement."""
    looks = [np.stack(blocks) for blocks in zip(*(seen[1:] for seen in observations), strict=True)]
    time_s = observations[-1].time_s
    return EmptyPad(
        Observation(time_s, *(blocks.mean(0) for blocks in looks)), Observation(time_s, *map(_noise, looks))
    )


def _noise(looks: Float[np.ndarray, "n rows columns 3"]) -> Float[np.ndarray, "rows columns 3"]:
    """The noise of each block, at least the median of all blocks, because few observations can underestimate it."""
    deviation = looks.std(0, ddof=1)
    return np.maximum(deviation, np.median(deviation)).astype(np.float32)


def known_pad(visual: Image, tactile: Image) -> EmptyPad:
    """The empty pad from one raw pair, such as the backgrounds of a sensor file. Its noise is unknown."""
    seen = observe(0.0, visual, tactile)
    return EmptyPad(seen, Observation(0.0, *map(np.zeros_like, seen[1:])))


def step(config: GuideConfig, state: State, observation: Observation) -> tuple[State, End | None]:
    """Advance the guide by one pair of images.

    Returns:
        The new state, and "initial", "final" or None: the end as which the caller must save the previous pair of
        images. The new pair proves that the object did not move while the previous pair was taken.
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
    looks_empty = state.trusted or (state.empty is not None and not state.contact)
    match state.stage:
        case Stage.CLEAR if looks_empty and _rested(config, state, config.empty_s):
            # The empty pad is measured again for each trajectory, to follow slow changes of the light.
            empty = empty_pad(state.window)
            return dataclasses.replace(_enter(state, Stage.PLACE), empty=empty, trusted=False), None
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


def confirm(state: State) -> State:
    """The state after the person has confirmed that the pad is empty, the object released, or the trajectory good."""
    if state.stage is Stage.CLEAR:
        return dataclasses.replace(interrupted(state), trusted=True)
    return _enter(state, _CONFIRMED[state.stage]) if state.stage in _CONFIRMED else state


def discard(state: State) -> State:
    """Discard the current trajectory, and return to the stage `CLEAR`."""
    return state if state.stage in (Stage.CLEAR, Stage.PLACE) else _enter(state, Stage.CLEAR)


def interrupted(state: State) -> State:
    """The state after a gap in the images, in which the object may have moved."""
    return dataclasses.replace(state, window=(), count=0, still=False)


def _enter(state: State, stage: Stage) -> State:
    initial = None if stage in (Stage.CLEAR, Stage.PLACE) else state.initial
    return dataclasses.replace(state, stage=stage, since_s=state.now_s, window=(), count=0, initial=initial)


def has_contact(config: GuideConfig, empty: EmptyPad, observation: Observation) -> bool:
    """Whether the tactile image shows a contact: enough small blocks differ from the empty pad.

    The median difference is subtracted first, so that a change in the brightness of the whole image is no contact.
    """
    change = observation.imprint - empty.mean.imprint
    change = change - np.median(change, axis=(0, 1))
    # A contact covers less than half of the image, and hardly changes this median. `known_pad` does not know the noise.
    shared = _NORMAL * np.median(np.abs(change))
    measured = empty.noise.imprint * math.sqrt(1 + 1 / config.pairs)  # of the image and of the mean of `pairs` images
    noise = np.maximum(measured, shared)
    return int((np.abs(change) > _threshold(config, noise)).any(-1).sum()) >= config.contact_blocks


def _same(config: GuideConfig, state: State, first: Observation, second: Observation) -> bool:
    """Whether two observations show no movement. Before the empty pad is known, the noise is estimated."""
    for stream in ("visual", "tactile") if config.watched == "both" else ("tactile",):
        one, two = getattr(first, stream), getattr(second, stream)
        if state.empty is None:
            # The median over all blocks is robust against a small object that moves.
            recent = [getattr(seen, stream) for seen in (*state.window[-4:], second)]
            noise = _NORMAL * np.median(np.abs(np.diff(recent, axis=0))) / math.sqrt(2)
        else:
            noise = getattr(state.empty.noise, stream)
        if (np.abs(two - one) > _threshold(config, math.sqrt(2) * noise)).any():
            return False
    return True


def _threshold(config: GuideConfig, noise: np.ndarray | np.floating) -> np.ndarray | np.floating:
    """The threshold of a change for a standard deviation of the noise."""
    return np.clip(config.deviations * np.asarray(noise), config.smallest_change, config.largest_threshold)


def _rested(config: GuideConfig, state: State, least_s: float) -> bool:
    return state.count >= config.pairs and state.window[-1].time_s - state.window[0].time_s >= least_s


def instruction(config: GuideConfig, state: State) -> str:
    """The instruction for the person, after `config.hint_s` seconds in the same stage with a hint."""
    words, hint = _WORDS[state.stage]
    if state.stage is Stage.CLEAR and state.empty is None and not state.trusted:
        return f"{words} Then confirm."
    late = state.now_s is not None and state.since_s is not None and state.now_s - state.since_s >= config.hint_s
    return f"{words} {hint}".rstrip() if late else words
