"""The browser pages of `experiments.real collect`, `experiments.live` and `experiments.demo`.

Other sites in the same browser can neither see the images nor press the buttons (`hardware.web`). Actions need an HTTP
header that only the page itself can send, too.
"""

import abc
import contextlib
import json
import socket
import threading
import time
from pathlib import Path
from typing import Any, Generic, TypeVar

import cv2
import jax.numpy as jnp
import numpy as np

from experiments.shared.device import TwinHand
from experiments.shared.live import Image, Seen
from experiments.shared.terminal import SEEDS, say
from sts_jax import objects, physics
from sts_jax.evaluation import metrics
from sts_jax.hardware import Action, View, twin, web

_WIDEST = 820  # largest width of the images in the page (pixels)
_QUALITY = 80  # JPEG quality
_INTERVAL_S = 0.1  # time between two images of a stream (s)
_LAST_S = 0.4  # time at the end in which open pages can request the last facts (s)
_LARGEST = 1000  # largest size of a request's content (bytes)
# time after which all arriving images show a held object (s). It is longer than the lag of the twin's camera
_FRESH_S = 0.3

State = TypeVar("State")  # what a page shows


class Page(abc.ABC, Generic[State]):
    """A web server with one page, which shows the newest state."""

    document: Path  # HTML file of the page
    streams: tuple[str, ...]  # names of the live images. The page loads each from `NAME.mjpg`
    use = "watch"  # what people can do on the page

    def __init__(self, host: str, port: int, **constants: Any):
        """Start the server in a thread, and print the address. Port 0 selects a free one.

        `constants` are facts that do not change, as JSON values.
        """
        self._changed = threading.Condition()
        self.state: State | None = None  # the newest state, or None before the first one
        self._number = 0  # number of changes of the state so far
        self._facts = {"starting": "connecting", **constants, "ended": False}
        self._server = web.Server(host, port, type("Handler", (_Handler,), {"page": self}))
        self.host, self.port = host, self._server.server_port
        self._thread = threading.Thread(target=self._server.serve_forever, name="page", daemon=True)
        self._thread.start()
        reach = "only this computer" if self._server.is_local else "EVERY computer that reaches this address"
        self.url = f"{self._server.url}/"
        name = "" if self._server.is_local else f" (elsewhere: http://{socket.gethostname()}:{self.port}/)"
        say(f"open {self.url} in a browser{name}. The page listens on {host}, so {reach} can {self.use}")

    @abc.abstractmethod
    def facts(self, state: State) -> dict[str, Any]:
        """The content of the page without the images, as a dictionary of JSON values."""

    @abc.abstractmethod
    def image(self, state: State, path: str) -> Image | None:
        """The image of a state at a path without suffix, such as `visual`, or None if it has no such image."""

    def pressed(self, state: State, content: Any) -> bool:
        """Accept an action of the page, such as a pressed button, or return False."""
        return False

    def tell(self, text: str) -> None:
        """Print what the program does before the first state, and show it on the page."""
        say(text)
        self._facts["starting"] = text

    def show(self, state: State) -> None:
        """Update the images and all other values in all open pages."""
        with self._changed:
            self.state, self._number = state, self._number + 1
            self._changed.notify_all()

    def answer(self) -> dict[str, Any]:
        """All facts."""
        state = self.state
        return {**self._facts, "waiting": state is None, **({} if state is None else self.facts(state))}

    def wait(self, last: int) -> int | None:
        """Wait until there were more than `last` changes. Returns their number, or None if the program has ended."""
        with self._changed:
            self._changed.wait_for(lambda: self._facts["ended"] or self._number > last)
            return None if self._facts["ended"] else self._number

    def close(self) -> None:
        """Show in open pages that the program has ended, and stop the server."""
        with self._changed:
            self._facts["ended"] = True
            self._changed.notify_all()
        time.sleep(_LAST_S)
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


class _Handler(web.Handler):
    """Answers the requests of the page."""

    page: Page

    def do_GET(self) -> None:
        """Send the HTML page, its facts, an image or a stream."""
        path = self.path.partition("?")[0].removeprefix("/")
        name, _, kind = path.rpartition(".")
        with contextlib.suppress(OSError):  # the browser may have closed the connection
            if path == "":
                self.send("text/html; charset=utf-8", self.page.document.read_bytes())
            elif path == "view":
                self.send("application/json", json.dumps(self.page.answer()).encode())
            elif kind == "mjpg" and name in self.page.streams:
                self._stream(name)
            elif kind == "jpg" and (image := self._image(name)) is not None:
                self.send("image/jpeg", _jpeg(image))
            else:
                self.send_error(404)

    def do_POST(self) -> None:
        """Pass an action of the page to `Page.pressed`."""
        length, state = self.headers.get("Content-Length", ""), self.page.state
        with contextlib.suppress(OSError):
            if self.path != "/action" or self.headers.get("X-Collect") != "1":
                self.send_error(403)
            elif not length.isdecimal() or int(length) > _LARGEST:
                self.send_error(400)
            else:
                content = None
                with contextlib.suppress(ValueError):
                    content = json.loads(self.rfile.read(int(length)))
                self.send_response(204 if state is not None and self.page.pressed(state, content) else 409)
                self.end_headers()

    def _image(self, path: str) -> Image | None:
        state = self.page.state
        return None if state is None else self.page.image(state, path)

    def _stream(self, stream: str) -> None:
        self.begin_stream()
        number, shown = 0, None
        while (changed := self.page.wait(number)) is not None:
            number, image = changed, self._image(stream)
            if image is None or image is shown:
                continue
            shown = image
            self.send_frame(_jpeg(image))
            time.sleep(_INTERVAL_S)


def _jpeg(image: Image) -> bytes:
    """Reduce an image to at most `_WIDEST` pixels in width, and encode it as JPEG."""
    height, width = image.shape[:2]
    if width > _WIDEST:
        image = cv2.resize(image, (_WIDEST, round(height * _WIDEST / width)), interpolation=cv2.INTER_AREA)
    parameters = [cv2.IMWRITE_JPEG_QUALITY, _QUALITY]
    return cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), parameters)[1].tobytes()


class CollectPage(Page[View]):
    """The page of `experiments.real collect`, a `hardware.Person`: both streams, the instruction, and buttons.

    The constant `count` is the number of trajectories to reach, or None.
    """

    document = Path(__file__).with_name("page.html")
    streams = ("visual", "tactile")
    use = "watch and press the buttons"
    hand: TwinHand | None = None  # the hand of the sensor, if it is a twin
    _action: Action | None = None

    def show(self, state: View) -> None:
        """See `Page.show`. A button that was pressed twice does not count for the next stage or trajectory."""
        with self._changed:
            old = self.state
            confirmed = self._action is Action.CONFIRM and old is not None and old.stage is not state.stage
            if old is not None and self._action is not Action.STOP and (confirmed or old.number != state.number):
                self._action = None
            super().show(state)

    def action(self) -> Action | None:
        """The action of the button that was pressed last, or None if no button was pressed since the last call."""
        with self._changed:
            action, self._action = self._action, None
            return action

    def pressed(self, state: View, content: Any) -> bool:
        """Accept the action of a button, unless the page showed an old stage or trajectory. Stop always counts."""
        if self.hand is not None and isinstance(content, dict) and content.get("hand") in twin.COMMANDS:
            return self.hand.start(content["hand"])
        try:
            action, shown = Action(content["action"]), (content["stage"], content["number"])
        except (KeyError, TypeError, ValueError):
            return False
        if action is not Action.STOP and shown != (state.stage.value, state.number):
            return False
        with self._changed:
            self._action = action
        return True

    def facts(self, state: View) -> dict[str, Any]:
        """The instruction and the state of the recording."""
        pair, names = state.pair, ("instruction", "number", "confirmed", "contact", "still", "problem")
        return {
            **{name: getattr(state, name) for name in names},
            "stage": state.stage.value,
            "ends": [end for end in ("initial", "final") if getattr(state, end) is not None],
            "age_s": None if pair is None else time.monotonic() - max(pair.visual.time_s, pair.tactile.time_s),
            "hand": None if self.hand is None else self.hand.facts(),
        }

    def image(self, state: View, path: str) -> Image | None:
        """The newest image of a stream (`visual`), or an image of the current trajectory (`end/initial/visual`)."""
        *ends, stream = path.split("/")
        if stream not in self.streams or ends not in ([], ["end", "initial"], ["end", "final"]):
            return None
        pair = getattr(state, ends[1]) if ends else state.pair
        return None if pair is None else getattr(pair, stream).image


class LivePage(Page[Seen]):
    """The page of `experiments.live`: the live images, samples of the predicted images, and facts about them.

    The constant `title` names the source and the model.
    """

    document = Path(__file__).with_name("live_page.html")
    streams = ("visual", "tactile", "samples_visual", "samples_tactile")

    def facts(self, state: Seen) -> dict[str, Any]:
        """The rate, the latency, the contact and the outcomes."""
        if state.predicted is None:
            return {"waiting": True}
        names = ("outcomes", "contact", "occupied", "resting", "rate", "latency_ms", "time_s")
        facts = {name: getattr(state.predicted, name) for name in names}
        return {**facts, "age_s": time.monotonic() - state.time_s}

    def image(self, state: Seen, path: str) -> Image | None:
        """The newest image of a stream, or a mean image such as `mean_visual`."""
        if path in ("visual", "tactile"):
            return getattr(state, path)
        if path in self.streams or path in ("mean_visual", "mean_tactile"):
            return getattr(state.predicted, path.removeprefix("mean_"), None)
        return None


class DemoPage(LivePage):
    """The page of `experiments.demo`: that of `experiments.live`, with buttons that move the object of a twin.

    The constant `classes` has the classes of the objects, and `note` is a sentence about the model.
    """

    use = "watch and press the buttons"
    hand: TwinHand | None = None  # None: the twin has not started yet

    def facts(self, state: Seen) -> dict[str, Any]:
        """The facts of `LivePage`, the hand, which buttons can be pressed, and what happened after the release."""
        facts, hand = super().facts(state), self.hand
        if hand is None or state.predicted is None:
            return {**facts, "waiting": True}
        return {
            **facts,
            "hand": {**hand.facts(), "can": [command for command in twin.COMMANDS if self._can(state, command)]},
            "let_go": hand.let_go,
            "happened": self._happened(state),
        }

    def pressed(self, state: Seen, content: Any) -> bool:
        """Start the command of a button, if it is possible now."""
        try:
            command, category, seed = content["hand"], content.get("class"), int(content.get("seed", 0))
        except (AttributeError, KeyError, TypeError, ValueError):
            return False
        known = category is None or (category in objects.CATEGORIES and SEEDS[0] <= seed <= SEEDS[1])
        if self.hand is None or not known or not self._can(state, command):
            return False
        return self.hand.start(command, category if command == "hold" else None, seed)

    def _can(self, state: Seen, command: str) -> bool:
        """Whether a button can be pressed. A release needs a prediction from images of the held object."""
        hand, found = self.hand, state.predicted
        if hand is None or hand.doing is not None or command not in twin.COMMANDS:
            return False
        if command == "release":
            return found is not None and hand.held_s is not None and found.time_s > hand.held_s + _FRESH_S
        return True

    def _happened(self, state: Seen) -> dict[str, Any] | None:
        """Whether the released object fell off, and how far from the predicted centre it is at rest (mm)."""
        hand, found = self.hand, state.predicted
        assert hand is not None
        if not hand.let_go or hand.state["phase"] != "still" or found is None or found.pose is None:
            return None
        pose = np.asarray(hand.state["pose"], np.float32)
        error_mm = 1e3 * float(metrics.position_error(found.pose[None], pose[None])[0])
        return {"fell_off": bool(physics.fell_off(jnp.asarray(pose))), "error_mm": error_mm}
