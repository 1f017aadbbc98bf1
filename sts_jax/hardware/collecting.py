"""`collect`: the loop that reads a sensor, instructs a person, and saves trajectories in a session."""

import dataclasses
import enum
import time
from typing import Protocol, runtime_checkable

from sts_jax.hardware import guide
from sts_jax.hardware.camera import CameraError
from sts_jax.hardware.guide import EmptyPad, GuideConfig, Stage
from sts_jax.hardware.leds import LedError
from sts_jax.hardware.proof import LightError, Pair
from sts_jax.hardware.session import Session


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
    config: GuideConfig = GuideConfig(),
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
    state = guide.State(empty=empty, trusted=trusted)
    trajectory = _Trajectory(session, note)
    before, newest = session.confirmed, None
    failing_since_s: float | None = None
    refused: str | None = None  # error of the person's last action
    while count is None or session.confirmed < count:
        problem = _not_ready(session, state)
        try:
            pair = sensor.read()
            failing_since_s = None
        except (CameraError, LedError, LightError) as error:
            failing_since_s = failing_since_s or time.monotonic()
            if time.monotonic() - failing_since_s > patience_s:
                raise
            state, problem = guide.interrupted(state), str(error)
        else:
            if problem is None:
                try:
                    state = trajectory.observed(config, state, newest, pair)
                except OSError as error:  # the pair could not be saved. The next pair tries again
                    problem = str(error)
            newest = pair
        person.show(
            View(
                pair=newest,
                stage=state.stage,
                instruction=guide.instruction(config, state),
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


def _not_ready(session: Session, state: guide.State) -> str | None:
    """Why no new trajectory can be started, or None."""
    if state.stage in (Stage.CLEAR, Stage.PLACE):
        try:
            session.check_ready()
        except OSError as error:
            return str(error)
    return None


class _Trajectory:
    """The trajectory that is being collected."""

    def __init__(self, session: Session, note: str):
        self._session, self._note = session, note
        self._forget()

    def _forget(self) -> None:
        self.number: int | None = None  # None: nothing of it was saved
        self.ends: dict[guide.End, Pair] = {}

    def observed(self, config: GuideConfig, state: guide.State, previous: Pair | None, pair: Pair) -> guide.State:
        """Advance the guide by a pair, and save the previous pair if it is an initial or a final one."""
        time_s = max(pair.visual.time_s, pair.tactile.time_s)
        state, end = guide.step(config, state, guide.observe(time_s, pair.visual.image, pair.tactile.image))
        if end is not None:
            assert previous is not None  # the guide needs several pairs before it reports one to save
            if self.number is None:
                self.number = self._session.begin()
            self._session.save(self.number, end, previous)
            self.ends[end] = previous
        elif state.stage in (Stage.CLEAR, Stage.PLACE):
            self._forget()
        return state

    def acted(self, state: guide.State, action: Action) -> guide.State:
        """Advance the guide by an action of the person, and confirm or discard the trajectory."""
        if action is Action.DISCARD:
            if self.ends and self.number is not None:
                self._session.discard(self.number)
            self._forget()
            return guide.discard(state)
        if state.stage is Stage.REVIEW and self.number is not None:
            self._session.confirm(self.number, self._note)
            self._forget()
        return guide.confirm(state)
