"""`Hand`: the person of a collection whose object is simulated."""

from sts_jax.hardware.collecting import Action, AutomaticPerson, View
from sts_jax.hardware.guide import Stage
from sts_jax.hardware.twin.device import Twin

_COMMANDS = {Stage.CLEAR: "clear", Stage.PLACE: "hold", Stage.RELEASE: "release"}
_UNMOVED_S = 3.0  # s after the release in which nothing moves, so that the object stays where it was


class Hand(AutomaticPerson):
    """Moves the twin's object as the guide asks, and confirms every trajectory.

    It acts on the guide's views alone. As a person does, it confirms the release of an object that stays where it was.
    """

    def __init__(self, twin: Twin, *, patience_s: float = 60.0):
        """Keep the twin.

        Args:
            twin: Whose object is moved.
            patience_s: Longest time in one stage (s of the twin's clock).

        Raises:
            ValueError: `patience_s` is not positive.
        """
        if not patience_s > 0:
            raise ValueError(f"patience_s must be > 0, got {patience_s}")
        super().__init__()
        self._twin = twin
        self._patience_s = patience_s
        self._seen: Stage | None = None  # stage of the last view
        self._since_s = self._now_s = 0.0  # begin of that stage, and time of the last view

    def show(self, view: View) -> None:
        """Send the command of a new stage.

        Raises:
            ValueError: The guide waits for longer than `patience_s`.
        """
        super().show(view)
        entered, self._seen = view.stage is not self._seen, view.stage
        self._now_s = self._twin.now_s
        if entered or view.problem is not None:
            self._since_s = self._now_s
        if entered and view.stage in _COMMANDS:
            self._twin.command(_COMMANDS[view.stage])
        if self._now_s - self._since_s > self._patience_s:
            raise ValueError(
                f"the guide still asks `{view.instruction}` after {self._patience_s:g} s (contact: {view.contact}, "
                f"still: {view.still}): the thresholds of the guide do not suit the twin's images"
            )

    def action(self) -> Action | None:
        """Confirm in the review, and a release after which nothing moves."""
        if self._seen is Stage.RELEASE and self._now_s - self._since_s > _UNMOVED_S:
            return Action.CONFIRM
        return super().action()
