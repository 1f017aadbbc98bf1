"""`Hand`: the person of a collection whose object is simulated."""

from sts_jax.hardware.collecting import Action, AutomaticPerson, View
from sts_jax.hardware.guide import Stage
from sts_jax.hardware.session import Session
from sts_jax.hardware.twin.device import Twin

_UNSEEN_S = 3.0  # s in which the guide sees no contact of a held object, so that the next pose is tried
_UNSEEN = 10  # poses in a row without a contact, after which no other one is tried
_UNMOVED_S = 3.0  # s after the release in which nothing moves, so that the object stays where it was


class Hand(AutomaticPerson):
    """Moves the twin's object as the guide asks, and confirms every trajectory.

    It acts on the guide's views alone. As a person does, it confirms the release of an object that stays where it was.
    A held pose that shows no contact is left out together with its number in the session. Trajectory n of the session
    is therefore trajectory n of the scene, if the scene begins with the session's next number.
    """

    def __init__(self, twin: Twin, session: Session, *, patience_s: float = 60.0):
        """Keep twin and session.

        Args:
            twin: Whose object is moved.
            session: To which the trajectories are added.
            patience_s: Longest time in one stage (s of the twin's clock).

        Raises:
            ValueError: `patience_s` is not positive.
        """
        if not patience_s > 0:
            raise ValueError(f"patience_s must be > 0, got {patience_s}")
        super().__init__()
        self._twin, self._session = twin, session
        self._patience_s = patience_s
        self._seen: Stage | None = None  # stage of the last view
        self._since_s = self._now_s = 0.0  # begin of that stage, and time of the last view
        self._placed = False  # whether the object is on the pad
        self._held_s: float | None = None  # time since which it is held, without a problem of the session
        self._unseen = 0  # held poses in a row without a contact

    def show(self, view: View) -> None:
        """Send the command that a view asks for.

        Raises:
            ValueError: The guide waits for longer than `patience_s`, or sees no contact of many poses.
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
                f"the guide still asks `{view.instruction}` after {self._now_s - self._since_s:.1f} s "
                f"(contact: {view.contact}, still: {view.still}): its thresholds do not suit the twin's images"
            )

    def action(self) -> Action | None:
        """Confirm in the review, and a release after which nothing moves."""
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
