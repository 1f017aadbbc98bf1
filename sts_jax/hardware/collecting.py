"""Collecting trajectories: the guide, which leads a person through the stages, and the loop `collect`.

The guide is a pure function of images. A movement is a change of the mean colour of a block (24 rows of 32) between two
images. A contact is a difference between the mean colours of a small block (48 rows of 64, because a contact can be
small) in the tactile image and in a tactile image of the empty pad. Means are compared, because the noise of single
pixels averages out in them. A change counts if it exceeds a multiple of the noise of the mean, but at least 3 and at
most 24 of 255.
"""

import dataclasses
import enum
import math
import time
from collections.abc import Sequence
from typing import Literal, NamedTuple, Protocol, runtime_checkable

import cv2
import numpy as np
from jaxtyping import Float

from sts_jax.hardware.camera import CameraError
from sts_jax.hardware.leds import LedError
from sts_jax.hardware.session import End, Image, Session
from sts_jax.hardware.sts import LightError, Pair, thumbnail

Blocks = Float[np.ndarray, "24 32 3"]  # means of an image's blocks, 0 to 255
SmallBlocks = Float[np.ndarray, "48 64 3"]  # means of blocks of half the width and height, 0 to 255

_NORMAL = 1.4826  # ratio of the standard deviation to the median absolute deviation of a normal distribution
_SMALL_BLOCKS = 64, 48  # numbers of columns and rows of the small blocks
_WAIT_S = 0.1  # wait after a read that failed (s)
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
            raise ValueError(f"largest_threshold must be >= smallest_change, got {self.largest_threshold}")


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
    """Advance the guide by one pair of images. Returns the new state, and the end as which to save the previous pair.

    The new pair proves that the object did not move while the previous pair was taken.
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


class Action(enum.Enum):
    """An action of the person."""

    CONFIRM = "confirm"  # confirm the current stage: the pad is empty, the object is released, the trajectory is good
    DISCARD = "discard"  # discard the current trajectory
    STOP = "stop"  # end the collection


@dataclasses.dataclass(frozen=True, eq=False)
class View:
    """What `collect` shows to the person."""

    pair: Pair | None  # newest pair of images, None: there is none yet
    stage: Stage  # current stage of the guide
    instruction: str  # instruction for the person, as text
    contact: bool  # True if the last tactile image shows a contact
    still: bool  # True if nothing moves
    number: int | None  # number of the current trajectory, None: its initial pair was not taken yet
    confirmed: int  # number of trajectories of the session that are confirmed and on disk
    problem: str | None  # message of the error that prevents collecting at present, or None
    initial: Pair | None  # initial pair of the current trajectory, None: not taken yet
    final: Pair | None  # final pair of the current trajectory, None: not taken yet


@runtime_checkable
class PairReader(Protocol):
    """A sensor, such as `STS`, `Replay` or `twin.VirtualSensor`."""

    def read(self) -> Pair:
        """Return a new visual and a new tactile image. Both arrive after the beginning of the call."""


@runtime_checkable
class Person(Protocol):
    """The interface to the person, such as a web page or a terminal. Each method must return immediately."""

    def show(self, view: View) -> None:
        """Show the newest images and the instruction. `collect` calls this after each attempt to read a pair."""

    def action(self) -> Action | None:
        """The next action, which refers to the `View` that was last passed to `show`. None: there is none."""


class AutomaticPerson:
    """A `Person` that confirms every recorded trajectory. Another program must move the objects."""

    def __init__(self) -> None:
        self._stage = Stage.CLEAR

    def show(self, view: View) -> None:
        """Store the stage, on which the action depends."""
        self._stage = view.stage

    def action(self) -> Action | None:
        """Confirm in the stage `REVIEW`, otherwise None."""
        return Action.CONFIRM if self._stage is Stage.REVIEW else None


def collect(
    sensor: PairReader,
    session: Session,
    person: Person,
    *,
    config: GuideConfig = GuideConfig(),
    empty: EmptyPad | None = None,
    trusted: bool = False,
    count: int | None = None,
    note: str = "",
    patience_s: float = 60.0,
) -> int:
    """Collect trajectories until the person stops, or until the session has enough of them.

    Args:
        empty: Appearance of the empty pad, from `known_pad`. None: the empty pad is measured at the beginning.
        trusted: True if the pad is certainly empty at the beginning. If False and `empty` is None, the person has to
            confirm that the pad is empty.
        count: Number of confirmed trajectories in the session, earlier ones included, at which collecting ends.
        note: Text that is stored with each trajectory.
        patience_s: Longest time without images (s), such as while the camera is unplugged. The person sees the error.

    Returns:
        Number of trajectories that were confirmed during this call.
    """
    state = State(empty=empty, trusted=trusted)
    trajectory = _Trajectory(session, note)
    before, newest = session.confirmed, None
    failing_since_s: float | None = None
    refused: str | None = None  # error of the person's last action
    while count is None or session.confirmed < count:
        problem = None
        try:
            pair = sensor.read()
            failing_since_s, previous, newest = None, newest, pair
            state = trajectory.observed(config, state, previous, pair)
        except (CameraError, LedError, LightError) as error:
            failing_since_s = failing_since_s or time.monotonic()
            if time.monotonic() - failing_since_s > patience_s:
                raise
            time.sleep(_WAIT_S)
            state, problem = interrupted(state), str(error)
        except OSError as error:  # the disk is full, or the pair could not be saved. The next pair tries again
            problem = str(error)
        person.show(
            View(
                pair=newest,
                stage=state.stage,
                instruction=instruction(config, state),
                contact=state.contact,
                still=state.still,
                number=trajectory.number,
                confirmed=session.confirmed,
                problem=problem or refused,
                initial=trajectory.ends.get("initial"),
                final=trajectory.ends.get("final"),
            )
        )
        action = person.action()
        if action is Action.STOP:
            break
        if action is not None and problem is None:
            try:
                state, refused = trajectory.acted(state, action), None
            except OSError as error:
                refused = str(error)
    return session.confirmed - before


class _Trajectory:
    def __init__(self, session: Session, note: str):
        self._session, self._note = session, note
        self.number: int | None = None  # None: nothing of it was saved
        self.ends: dict[End, Pair] = {}

    def observed(self, config: GuideConfig, state: State, previous: Pair | None, pair: Pair) -> State:
        """Advance the guide by a pair, and save the previous pair if it is an initial or a final one."""
        if state.stage in (Stage.CLEAR, Stage.PLACE):
            self._session.check_ready()
        time_s = max(pair.visual.time_s, pair.tactile.time_s)
        state, end = step(config, state, observe(time_s, pair.visual.image, pair.tactile.image))
        if end is not None:
            assert previous is not None  # the guide needs several pairs before it reports one to save
            if self.number is None:
                self.number = self._session.begin()
            self._session.save(self.number, end, previous)
            self.ends[end] = previous
        elif state.stage in (Stage.CLEAR, Stage.PLACE):
            self.number, self.ends = None, {}
        return state

    def acted(self, state: State, action: Action) -> State:
        """Advance the guide by an action of the person, and confirm or discard the trajectory."""
        if self.number is not None:
            if action is Action.DISCARD and self.ends:
                self._session.discard(self.number)
            elif action is Action.CONFIRM and state.stage is Stage.REVIEW:
                self._session.confirm(self.number, self._note)
        if action is Action.DISCARD or state.stage is Stage.REVIEW:
            self.number, self.ends = None, {}
        return discard(state) if action is Action.DISCARD else confirm(state)
