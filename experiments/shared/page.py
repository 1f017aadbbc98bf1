"""A browser page with both live streams, the current instruction and buttons, for a person who collects."""

import time
from pathlib import Path
from typing import Any

from experiments.shared.site import Image, Site
from sts_jax.hardware import Action, View

_PAGE = Path(__file__).with_name("page.html")
_STREAMS = ("visual", "tactile")


class Page(Site):
    """A `Person` in front of a browser."""

    def __init__(self, host: str, port: int, *, count: int | None = None):
        """Listen.

        Args:
            host: Address or name, such as 127.0.0.1.
            port: 0: a free one.
            count: Number of trajectories that is shown as the goal.

        Raises:
            OSError: The address cannot be used. The message names it and the remedy.
        """
        self._count = count
        self._view: View | None = None
        self._action: Action | None = None
        super().__init__(host, port, _PAGE, _STREAMS)

    def show(self, view: View) -> None:
        """Show a view in all open pages."""
        with self._changed:
            self._view, self._number = view, self._number + 1
            self._changed.notify_all()

    def action(self) -> Action | None:
        """The action of the button that was pressed last."""
        with self._changed:
            action, self._action = self._action, None
            return action

    def pressed(self, content: Any) -> bool:
        """Take over an action, unless the page showed another stage than the current one."""
        with self._changed:
            view = self._view
            try:
                action = Action(content["action"])
                shown = content["stage"], content["number"]
            except (KeyError, TypeError, ValueError):
                return False
            if view is None or (action is not Action.STOP and shown != (view.stage.value, view.number)):
                return False
            self._action = action
            return True

    def facts(self) -> dict[str, Any]:
        """The current view without its images."""
        with self._changed:
            view, ended = self._view, self._ended
        if view is None:
            return {
                **{"stage": "", "instruction": "Connecting", "number": None, "confirmed": 0, "waiting": 0},
                **{"contact": False, "still": False, "problem": None, "count": self._count, "ends": []},
                **{"age_s": None, "ended": ended},
            }
        pair = view.pair
        return {
            "stage": view.stage.value,
            "instruction": view.instruction,
            "number": view.number,
            "confirmed": view.confirmed,
            "waiting": view.waiting,
            "contact": view.contact,
            "still": view.still,
            "problem": view.problem,
            "count": self._count,
            "ends": [end for end in ("initial", "final") if getattr(view, end) is not None],
            "age_s": None if pair is None else time.monotonic() - max(pair.visual.time_s, pair.tactile.time_s),
            "ended": ended,
        }

    def image(self, stream: str) -> Image | None:
        """The newest image of a stream."""
        with self._changed:
            pair = None if self._view is None else self._view.pair
        return None if pair is None else getattr(pair, stream).image

    def still(self, path: str) -> Image | None:
        """An image of the current trajectory, such as `end/initial/visual.jpg`."""
        head, _, rest = path.partition("/")
        end, _, name = rest.partition("/")
        stream = name.removesuffix(".jpg")
        if head != "end" or end not in ("initial", "final") or stream not in _STREAMS:
            return None
        with self._changed:
            pair = getattr(self._view, end, None)
        return None if pair is None else getattr(pair, stream).image
