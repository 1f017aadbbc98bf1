"""`collect`: the loop that reads a sensor, instructs a person, and saves trajectories in a session."""

import dataclasses
import enum
import time
from typing import Protocol, runtime_checkable

from sts_jax.hardware import guide
from sts_jax.hardware.camera import CameraLostError, CameraTimeoutError, FrozenCameraError, StaleFrameError
from sts_jax.hardware.guide import EmptyPad, GuideConfig, Stage
from sts_jax.hardware.leds import DisconnectedError, LedTimeoutError
from sts_jax.hardware.proof import LightError, Pair
from sts_jax.hardware.session import Session

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
    """The interface to the person, such as a web page or a terminal.

    Each method must return immediately, because `collect` reads no images until the method returns.
    """

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
    config: GuideConfig | None = None,
    empty: EmptyPad | None = None,
    trusted: bool = False,
    count: int | None = None,
    note: str = "",
    patience_s: float = 60.0,
) -> int:
    """Collect trajectories until the person stops, or until the session has enough of them.

    Args:
        sensor: Connected sensor.
        session: Session in which the trajectories are saved. `collect` does not close it.
        person: Interface to the person.
        config: Thresholds and times of the guide. None: the defaults of `GuideConfig`.
        empty: Appearance of the empty pad, from `known_pad`. None: the empty pad is measured at the beginning.
        trusted: True if the pad is certainly empty at the beginning. If False and `empty` is None, the person has to
            confirm that the pad is empty.
        count: Number of confirmed trajectories in the session, earlier ones included, at which collecting ends. None:
            no limit.
        note: Text that is stored with each trajectory.
        patience_s: Longest time without images (s), for example while the camera is unplugged. The person sees the
            error, and `collect` tries again.

    Returns:
        Number of trajectories that were confirmed during this call.
    """
    return _Collecting(sensor, session, person, config or GuideConfig(), note).run(
        guide.start(empty, trusted=trusted), count, patience_s
    )


class _Collecting:
    """The state of `collect` and its loop."""

    def __init__(self, sensor: PairReader, session: Session, person: Person, config: GuideConfig, note: str):
        self._sensor, self._session, self._person = sensor, session, person
        self._config, self._note = config, note
        self._pair: Pair | None = None  # the newest pair
        self._number: int | None = None  # number of the current trajectory
        self._ends: dict[guide.End, Pair] = {}  # pairs of the current trajectory
        self._confirmed = 0  # trajectories that were confirmed in this loop

    def run(self, state: guide.State, count: int | None, patience_s: float) -> int:
        before = self._session.confirmed
        failing_since: float | None = None
        refused: str | None = None  # error of the person's last action
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
                    try:
                        state = self._observed(state, pair)
                    except OSError as error:  # the pair could not be saved. The next pair tries again
                        problem = str(error)
                self._pair = pair
            self._person.show(self._view(state, problem or refused))
            action = self._person.action()
            if action is Action.STOP:
                break
            if action is not None and problem is None:
                try:
                    state, refused = self._acted(state, action), None
                except OSError as error:
                    refused = str(error)
        return self._confirmed

    def _not_ready(self, state: guide.State) -> str | None:
        if state.stage not in (Stage.CLEAR, Stage.PLACE):
            return None
        try:
            self._session.check_ready()
        except OSError as error:
            return str(error)
        return None

    def _observed(self, state: guide.State, pair: Pair) -> guide.State:
        """Advance the guide by a pair, and save the previous pair if it is an initial or a final one."""
        time_s = max(pair.visual.time_s, pair.tactile.time_s)
        state, end = guide.step(self._config, state, guide.observe(time_s, pair.visual.image, pair.tactile.image))
        if end is not None:
            assert self._pair is not None  # the guide needs several pairs before it reports one to save
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
            problem=problem,
            initial=self._ends.get("initial"),
            final=self._ends.get("final"),
        )
