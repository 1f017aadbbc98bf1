"""The browser page of `experiments.real collect`, with both live streams, the current instruction and buttons."""

import time
from pathlib import Path
from typing import Any

from experiments.shared.site import Image, Site
from sts_jax.hardware import Action, View

_PAGE = Path(__file__).with_name("page.html")
_STREAMS = ("visual", "tactile")


class Page(Site):
    """A browser page that implements `hardware.Person`.

    The page shows each `hardware.View` that it receives, and returns the actions of the person who uses the browser.
    """

    def __init__(self, host: str, port: int, *, count: int | None = None):
        """Start the server of the page.

        Args:
            host: Address or name on which the server listens, such as 127.0.0.1.
            port: TCP port. 0 selects a free one.
            count: Number of trajectories that the page shows as the goal. None: no goal.

        Raises:
            OSError: The address cannot be used. The message names the address and the remedy.
        """
        self._count = count
        self._view: View | None = None
        self._action: Action | None = None
        super().__init__(host, port, _PAGE, _STREAMS)

    def show(self, view: View) -> None:
        """Update all open pages with the images and the instruction in `view`."""
        with self._changed:
            self._view, self._number = view, self._number + 1
            self._changed.notify_all()

    def action(self) -> Action | None:
        """The action of the button that was pressed last, or None if no button was pressed since the last call."""
        with self._changed:
            action, self._action = self._action, None
            return action

    def pressed(self, content: Any) -> bool:
        """Accept the action of a button.

        Args:
            content: Decoded JSON with `action`, and with the `stage` and the `number` of the trajectory on the page.

        Returns:
            True if the action is accepted. An action is refused if the content is invalid, or if no view was shown yet.
            It is also refused if the page showed an old stage or trajectory, unless the action is `stop`.
        """
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
        """The values that the page shows besides the images, such as the instruction, as a dict for JSON."""
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
        """The newest image of a stream (`visual` or `tactile`), or None before the first pair of images."""
        with self._changed:
            pair = None if self._view is None else self._view.pair
        return None if pair is None else getattr(pair, stream).image

    def still(self, path: str) -> Image | None:
        """The image of the current trajectory at a URL path such as `end/initial/visual.jpg`.

        The first part of the path is always `end`. The second part, `initial` or `final`, selects a pair of images. The
        third part selects the visual or the tactile image of this pair.
        The result is None if the image was not taken yet, or if the path has another form.
        """
        head, _, rest = path.partition("/")
        end, _, name = rest.partition("/")
        stream = name.removesuffix(".jpg")
        if head != "end" or end not in ("initial", "final") or stream not in _STREAMS:
            return None
        with self._changed:
            pair = getattr(self._view, end, None)
        return None if pair is None else getattr(pair, stream).image
