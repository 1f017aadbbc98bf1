"""A browser page with both live streams, the current instruction and buttons, for a person who collects."""

import contextlib
import http.server
import ipaddress
import json
import threading
import time
import urllib.parse
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from sts_jax.hardware import Action, Shot, View

_PAGE = Path(__file__).with_name("page.html")
_WIDEST = 820  # pixels, to which images are reduced
_QUALITY = 80  # of JPEG
_INTERVAL_S = 0.1  # between two images of a stream
_OPEN_S = 2.0  # s since the last question of a page after which it counts as closed
_LAST_S = 0.4  # s for open pages to ask once more at the end
_LARGEST = 1000  # bytes of a request


class Page:
    """A `Person` in front of a browser. The server listens on one address only.

    Requests under another name than the address are refused, and so are actions without the page's own header. Another
    page that is open in the same browser can therefore neither see the streams nor press the buttons.
    """

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
        self._changed = threading.Condition()
        self._view: View | None = None
        self._number = 0  # of the view
        self._action: Action | None = None
        self._ended = False
        self._asked_s = -float("inf")  # when a page last asked for the view
        page = self

        class Handler(_Handler):
            owner = page

        try:
            self._server = http.server.ThreadingHTTPServer((host, port), Handler)
        except (OSError, OverflowError) as error:
            raise OSError(
                f"the page cannot be served at {host}:{port} ({error}): give another --host or --port, or --headless."
            ) from error
        self._server.daemon_threads = True
        self.host, self.port = host, self._server.server_port
        self._thread = threading.Thread(target=self._server.serve_forever, name="page", daemon=True)
        self._thread.start()

    @property
    def url(self) -> str:
        """The address of the page."""
        return f"http://{self.host}:{self.port}/"

    @property
    def is_local(self) -> bool:
        """Whether only programs of this computer can reach the page."""
        with contextlib.suppress(ValueError):
            return ipaddress.ip_address(self.host).is_loopback
        return self.host == "localhost"

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

    def close(self) -> None:
        """Show in the open pages that collecting has ended, and stop."""
        with self._changed:
            self._ended = True
            self._changed.notify_all()
        if time.monotonic() - self._asked_s < _OPEN_S:
            time.sleep(_LAST_S)
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

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
        """The current view without its images, as JSON."""
        with self._changed:
            view, ended = self._view, self._ended
            self._asked_s = time.monotonic()
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

    def wait(self, last: int) -> tuple[int, View | None]:
        """Wait for a view after the one with a number. None: there will be no more."""
        with self._changed:
            self._changed.wait_for(lambda: self._ended or self._number > last)
            return self._number, None if self._ended else self._view

    def end_image(self, path: str) -> bytes | None:
        """An image of the current trajectory, such as `initial/visual.jpg`."""
        end, _, name = path.partition("/")
        stream = name.removesuffix(".jpg")
        with self._changed:
            pair = getattr(self._view, end, None) if end in ("initial", "final") else None
        return None if pair is None or stream not in ("visual", "tactile") else _jpeg(getattr(pair, stream))


class _Handler(http.server.BaseHTTPRequestHandler):
    """Requests of a page."""

    owner: Page

    def log_message(self, *_: object) -> None:
        """Print nothing."""

    def do_GET(self) -> None:
        """Answer with the page, the view, an image or a stream."""
        path = self.path.partition("?")[0].removeprefix("/")
        with contextlib.suppress(OSError):  # the browser has left
            if not self._own_name():
                self.send_error(403, "Open the page under the address that the program has printed")
            elif path == "":
                self._send("text/html; charset=utf-8", _PAGE.read_bytes())
            elif path == "view":
                self._send("application/json", json.dumps(self.owner.facts()).encode())
            elif path in ("visual.mjpg", "tactile.mjpg"):
                self._stream(path.removesuffix(".mjpg"))
            elif path.startswith("end/") and (data := self.owner.end_image(path.removeprefix("end/"))) is not None:
                self._send("image/jpeg", data)
            else:
                self.send_error(404)

    def do_POST(self) -> None:
        """Take over an action."""
        length = self.headers.get("Content-Length", "")
        with contextlib.suppress(OSError):
            if not self._own_name() or self.path != "/action" or self.headers.get("X-Collect") != "1":
                self.send_error(403)
                return
            if not length.isdecimal() or int(length) > _LARGEST:
                self.send_error(400)
                return
            try:
                content = json.loads(self.rfile.read(int(length)))
            except ValueError:
                self.send_error(400)
                return
            self.send_response(204 if self.owner.pressed(content) else 409)
            self.end_headers()

    def _own_name(self) -> bool:
        """Whether the browser asks for the address on which the server listens, and not for another site's name."""
        name = ""
        with contextlib.suppress(ValueError):
            name = urllib.parse.urlsplit("//" + self.headers.get("Host", "")).hostname or ""
        if name == self.owner.host or (self.owner.is_local and name in ("localhost", "127.0.0.1", "::1")):
            return True
        with contextlib.suppress(ValueError):  # all addresses of this computer
            return self.owner.host in ("0.0.0.0", "::") and bool(ipaddress.ip_address(name))
        return False

    def _send(self, kind: str, data: bytes) -> None:
        self.send_response(200)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(data)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.end_headers()
        self.wfile.write(data)

    def _stream(self, stream: str) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        number, shown = 0, None
        while True:
            number, view = self.owner.wait(number)
            if view is None:
                return
            if view.pair is None or view.pair is shown:
                continue
            shown = view.pair
            data = _jpeg(getattr(shown, stream))
            head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}\r\n\r\n"
            self.wfile.write(head.encode() + data + b"\r\n")
            time.sleep(_INTERVAL_S)


def _jpeg(shot: Shot) -> bytes:
    """An image, reduced and encoded."""
    height, width = shot.image.shape[:2]
    image = np.asarray(shot.image)
    if width > _WIDEST:
        image = cv2.resize(image, (_WIDEST, round(height * _WIDEST / width)), interpolation=cv2.INTER_AREA)
    parameters = [cv2.IMWRITE_JPEG_QUALITY, _QUALITY]
    return cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), parameters)[1].tobytes()
