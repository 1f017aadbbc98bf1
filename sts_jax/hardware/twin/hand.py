"""`Hand`: a program that replaces the person during the collection of trajectories, and moves the simulated object."""

from sts_jax.hardware.collecting import Action, AutomaticPerson, View
from sts_jax.hardware.guide import Stage
from sts_jax.hardware.session import Session
from sts_jax.hardware.twin.device import Twin

_UNSEEN_S = 3.0  # time without a visible contact after which the next held pose is tried (s)
_UNSEEN = 10  # held poses in a row without a visible contact after which the hand gives up
_UNMOVED_S = 3.0  # time without motion after a release after which the object counts as resting where it was (s)


class Hand(AutomaticPerson):
    """A program that replaces the person in `hardware.collect`, and moves the object on a `Twin` (a simulated sensor).

    `hardware.collect` shows its instructions as a `View`. The hand sends the matching commands to the twin, and
    confirms every trajectory. If an object does not move after its release, the hand confirms the release, as a person
    would. If `hardware.collect` detects no contact between a held object and the pad within 3 s, the hand gives up this
    trajectory, and continues with the first pose of the next one. The number of the trajectory stays unused in the
    session.

    The session numbers the trajectories, and the scene of the twin numbers them independently. A trajectory has the
    same number in both if the scene starts to count at the number of the session's next trajectory:
    `ObjectScene(first=hardware.next_recording(folder))`.
    """

    def __init__(self, twin: Twin, session: Session, *, patience_s: float = 60.0):
        """Prepare the hand. The object does not move before the first call of `show`.

        Args:
            twin: Twin whose object the hand moves.
            session: Session that receives the trajectories.
            patience_s: Longest time without a new instruction, > 0 (s on the twin's clock).

        Raises:
            ValueError: `patience_s` is not positive.
        """
        if not patience_s > 0:
            raise ValueError(f"patience_s must be > 0, got {patience_s}")
        super().__init__()
        self._twin, self._session = twin, session
        self._patience_s = patience_s
        self._seen: Stage | None = None  # stage of the last view
        self._since_s = self._now_s = 0.0  # begin of that stage, and time of the last view (s)
        self._placed = False  # True if the object is on the pad
        self._held_s: float | None = None  # time since which the object is held without a problem of the session (s)
        self._unseen = 0  # held poses in a row without a visible contact

    def show(self, view: View) -> None:
        """Move the object on the `Twin` (a simulated sensor) as the newest instruction of `hardware.collect` requires.

        Args:
            view: Newest images and instruction. `hardware.collect` calls this method with each new view.

        Raises:
            ValueError: The collection stays in the same stage for longer than the argument `patience_s` of `Hand`, and
                `view.problem` is None. Or no contact is detected in ten successive poses of the held object.
        """
        super().show(view)
        entered, self._seen = view.stage is not self._seen, view.stage
        self._now_s = self._twin.now_s
        if entered or view.problem is not None:
            self._since_s = self._now_s
        if view.problem is not None and self._held_s is not None:
            self._held_s = self._now_s
        match view.stage:
            case Stage.CLEAR if self._placed:
                self._twin.command("clear")
                self._placed, self._held_s = False, None
            case Stage.PLACE:
                self._place()
            case Stage.RELEASE if self._held_s is not None:
                self._twin.command("release")
                self._held_s, self._unseen = None, 0
        if self._now_s - self._since_s > self._patience_s or self._unseen == _UNSEEN:
            raise ValueError(
                f"hardware.collect has shown the instruction `{view.instruction}` for "
                f"{self._now_s - self._since_s:.1f} s (contact: {view.contact}, still: {view.still}). "
                f"Number of poses that the hand tried without a detected contact: {self._unseen}. "
                "The thresholds of hardware.collect do not suit the images of the simulated sensor, or patience_s of "
                f"Hand ({self._patience_s:g} s) is too short. Change the argument config (a GuideConfig) of "
                "hardware.collect, or increase patience_s"
            )

    def action(self) -> Action | None:
        """Return the action that a person would take next. `hardware.collect` calls this method.

        Returns:
            `Action.CONFIRM` if a trajectory waits for its review, or if the object has not moved in the 3 s after its
            release. Otherwise None.
        """
        if self._seen is Stage.RELEASE and self._now_s - self._since_s > _UNMOVED_S:
            return Action.CONFIRM
        return super().action()

    def _place(self) -> None:
        """Hold the object in the next pose, unless the guide may still see the contact of the current one."""
        if self._held_s is None:
            self._placed, self._held_s = True, self._now_s
            self._twin.command("hold")
        elif self._now_s - self._held_s > _UNSEEN_S:
            self._held_s = self._now_s
            self._unseen += 1
            self._session.begin()
            self._twin.command("hold")
