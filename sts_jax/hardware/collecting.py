"""`collect`: sensor, guide and session together. A person, or a program in place of one, sees views and acts."""

import dataclasses
import enum
import time
from typing import Protocol, runtime_checkable

from sts_jax.hardware import guide
from sts_jax.hardware.camera_errors import CameraLostError, CameraTimeoutError, FrozenCameraError, StaleFrameError
from sts_jax.hardware.guide import EmptyPad, GuideConfig, Stage
from sts_jax.hardware.ports import DisconnectedError, LedTimeoutError
from sts_jax.hardware.session import Session, SessionError
from sts_jax.hardware.shots import LightError, Pair

_PASSING = (
    CameraLostError,
    CameraTimeoutError,
    FrozenCameraError,
    StaleFrameError,
    DisconnectedError,
    LedTimeoutError,
    LightError,
)


class Action(enum.Enum):
    """What a person can do."""

    CONFIRM = "confirm"
    DISCARD = "discard"
    STOP = "stop"


@dataclasses.dataclass(frozen=True, eq=False)
class View:
    """What a person sees."""

    pair: Pair | None  # the newest images, None: there are none yet
    stage: Stage
    instruction: str
    contact: bool
    still: bool
    number: int | None  # of the current trajectory, None: its initial pair was not taken yet
    confirmed: int  # trajectories of the session that are confirmed and on disk
    waiting: int  # changes that are not on disk yet
    problem: str | None  # why it does not go on
    initial: Pair | None  # of the current trajectory
    final: Pair | None  # of the current trajectory


@runtime_checkable
class PairReader(Protocol):
    """What takes pairs of images: `STS`, or the digital twin's `VirtualSensor`."""

    def read(self) -> Pair:
        """Take an image of each stream. Both arrive after the call."""


@runtime_checkable
class Person(Protocol):
    """Shows views and returns actions. Neither method may wait."""

    def show(self, view: View) -> None:
        """Show a view, about as often as pairs are taken."""

    def action(self) -> Action | None:
        """The next action, or None. It refers to the last view."""


class AutomaticPerson:
    """Confirms every trajectory. The object must be moved by something else, such as a digital twin."""

    def __init__(self) -> None:
        self._stage = Stage.CLEAR

    def show(self, view: View) -> None:
        """Note the stage."""
        self._stage = view.stage

    def action(self) -> Action | None:
        """Confirm in the review."""
        return Action.CONFIRM if self._stage is Stage.REVIEW else None


def collect(
    sensor: PairReader,
    session: Session,
    person: Person,
    *,
    config: GuideConfig | None = None,
    empty: EmptyPad | None = None,
    trusted: bool = False,
    count: int | None = None,
    note: str = "",
    patience_s: float = 60.0,
) -> int:
    """Collect trajectories until the person stops, or until there are enough.

    Args:
        sensor: A connected sensor.
        session: Where the pairs are saved. It stays open.
        person: Shows the instructions, confirms and discards.
        config: Thresholds and times of the guide.
        empty: The empty pad, from the backgrounds of a sensor file. None: measured at the start.
        trusted: Whether the pad is empty at the start. Otherwise the person has to confirm it if `empty` is None.
        count: Number of confirmed trajectories in the session, earlier ones included, after which collecting ends.
        note: Stored with each trajectory.
        patience_s: Longest time without images (s), during which lost devices may return. The person sees the problem.

    Returns:
        The number of trajectories that were confirmed during this call.

    Raises:
        LightError, LedError, CameraError: As in `STS.read`, for longer than `patience_s`.
        SessionError: Something cannot be written, and too much is waiting.
    """
    return _Collecting(sensor, session, person, config or GuideConfig(), note).run(
        guide.start(empty, trusted=trusted), count, patience_s
    )


class _Collecting:
    """The loop of `collect`."""

    def __init__(self, sensor: PairReader, session: Session, person: Person, config: GuideConfig, note: str):
        self._sensor, self._session, self._person = sensor, session, person
        self._config, self._note = config, note
        self._pair: Pair | None = None  # the newest one
        self._number: int | None = None
        self._ends: dict[guide.End, Pair] = {}
        self._confirmed = 0

    def run(self, state: guide.State, count: int | None, patience_s: float) -> int:
        before = self._session.confirmed
        failing_since: float | None = None
        while count is None or before + self._confirmed < count:
            problem = self._not_ready(state)
            try:
                pair = self._sensor.read()
                failing_since = None
            except _PASSING as error:
                now = time.monotonic()
                failing_since = now if failing_since is None else failing_since
                if now - failing_since > patience_s:
                    raise
                state, pair, problem = guide.interrupted(state), None, str(error)
            if pair is not None:
                if problem is None:
                    state = self._observed(state, pair)
                self._pair = pair
            self._person.show(self._view(state, problem))
            action = self._person.action()
            if action is Action.STOP:
                break
            if action is not None and problem is None:
                state = self._acted(state, action)
        self._session.flush()
        return self._confirmed

    def _not_ready(self, state: guide.State) -> str | None:
        """Why no trajectory can begin."""
        if state.stage not in (Stage.CLEAR, Stage.PLACE):
            return None
        try:
            self._session.check_ready()
        except SessionError as error:
            return str(error)
        return None

    def _observed(self, state: guide.State, pair: Pair) -> guide.State:
        """Step the guide, and save the pair of an end that was reached."""
        time_s = max(pair.visual.time_s, pair.tactile.time_s)
        state, end = guide.step(self._config, state, guide.observe(time_s, pair.visual.image, pair.tactile.image))
        if end is not None:
            assert self._pair is not None  # an end needs a window of several pairs
            if self._number is None:
                self._number = self._session.begin()
            self._session.save(self._number, end, self._pair)
            self._ends[end] = self._pair
        elif state.stage in (Stage.CLEAR, Stage.PLACE):
            self._forget()
        return state

    def _acted(self, state: guide.State, action: Action) -> guide.State:
        if action is Action.CONFIRM:
            if state.stage is Stage.REVIEW and self._number is not None:
                self._session.confirm(self._number, self._note)
                self._confirmed += 1
                self._forget()
            return guide.confirm(state)
        if self._number is not None:
            self._session.discard(self._number)
            self._forget()
        return guide.discard(state)

    def _forget(self) -> None:
        self._number, self._ends = None, {}

    def _view(self, state: guide.State, problem: str | None) -> View:
        return View(
            pair=self._pair,
            stage=state.stage,
            instruction=guide.instruction(self._config, state),
            contact=state.contact,
            still=state.still,
            number=self._number,
            confirmed=self._session.confirmed,
            waiting=self._session.waiting,
            problem=problem,
            initial=self._ends.get("initial"),
            final=self._ends.get("final"),
        )
