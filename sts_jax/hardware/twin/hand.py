"""`Hand`: the person of a collection whose object is simulated."""

from sts_jax.hardware.collecting import AutomaticPerson, View
from sts_jax.hardware.guide import Stage
from sts_jax.hardware.twin.device import Twin

_COMMANDS = {Stage.CLEAR: "clear", Stage.PLACE: "hold", Stage.RELEASE: "release"}


class Hand(AutomaticPerson):
    """Moves the twin's object as the guide asks, and confirms every trajectory."""

    def __init__(self, twin: Twin):
        """Keep the twin."""
        super().__init__()
        self._twin = twin

    def show(self, view: View) -> None:
        """Send the command of a new stage."""
        if view.stage is not self._stage and (command := _COMMANDS.get(view.stage)) is not None:
            self._twin.command(command)
        super().show(view)
