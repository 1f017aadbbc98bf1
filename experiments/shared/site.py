"""A small web server for one page with live images. Other web sites in the same browser cannot see or use the page."""

import abc
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
from jaxtyping import UInt8

_WIDEST = 820  # largest width of the images in the page (pixels)
_QUALITY = 80  # JPEG quality
_INTERVAL_S = 0.1  # time between two images of a stream (s)
_OPEN_S = 2.0  # time since the last request for facts after which the page counts as closed (s)
_LAST_S = 0.4  # time at the end in which open pages can request the last facts (s)
_LARGEST = 1000  # largest size of a request's content (bytes)

Image = UInt8[np.ndarray, "height width 3"]


class Site(abc.ABC):
    """A web server with one page.

    The server listens on the given address. It refuses requests for another host name, and actions without the HTTP
    header that the page sends. Therefore, another site in the same browser cannot see the images or press the buttons.
    """

    def __init__(self, host: str, port: int, document: Path, streams: tuple[str, ...]):
        """Start the server in a thread.

        Args:
            host: Address or name on which the server listens, such as 127.0.0.1.
            port: TCP port. 0 selects a free one.
            document: Path of the HTML file of the page.
            streams: Names of the live images. The page loads each from `NAME.mjpg`.

        Raises:
            OSError: The address cannot be used. The message names the address and the remedy.
        """
        self.document, self.streams = document, streams
        self._changed = threading.Condition()
        self._number = 0  # number of changes of the content so far
        self._ended = False
        self._asked_s = -float("inf")  # time of the last request for facts, on the clock `time.monotonic` (s)
        site = self

        class Handler(_Handler):
            owner = site

        try:
            self._server = http.server.ThreadingHTTPServer((host, port), Handler)
        except (OSError, OverflowError) as error:
            raise OSError(
                f"the page cannot be served at {host}:{port} ({error}): give another --host or --port, or --headless"
            ) from error
        self._server.daemon_threads = True
        self.host, self.port = host, self._server.server_port
        self._thread = threading.Thread(target=self._server.serve_forever, name="page", daemon=True)
        self._thread.start()

    @abc.abstractmethod
    def facts(self) -> dict[str, Any]:
        """The content of the page without the images, as a dictionary of JSON values.

        The entry `ended` is True if the program has ended.
        """

    @abc.abstractmethod
    def image(self, stream: str) -> Image | None:
        """The newest image of a stream, or None before the first image.

        Until a newer image arrives, each call returns the same object.
        """

    def still(self, path: str) -> Image | None:
        """The image at a URL path such as `end/initial/visual.jpg`. The result is None if the site has no such image.

        Subclasses override this method if their page shows images that do not belong to a live stream. `Site` itself
        has no such images.
        """
        return None

    def pressed(self, content: Any) -> bool:
        """Accept or refuse an action of the page, such as a pressed button.

        Subclasses override this method if their page has actions. `Site` itself refuses every action.

        Args:
            content: Decoded JSON of the request.

        Returns:
            True if the action is accepted. False if it is invalid or comes too late.
        """
        return False

    @property
    def url(self) -> str:
        """The address of the page."""
        return f"http://{self.host}:{self.port}/"

    @property
    def is_local(self) -> bool:
        """True if only programs on this computer can reach the page."""
        with contextlib.suppress(ValueError):
            return ipaddress.ip_address(self.host).is_loopback
        return self.host == "localhost"

    @property
    def is_open(self) -> bool:
        """True if a browser shows the page at present."""
        return time.monotonic() - self._asked_s < _OPEN_S

    def asked(self) -> dict[str, Any]:
        """Return `facts`, the content of the page without the images, and record the time of this request."""
        self._asked_s = time.monotonic()
        return self.facts()

    def wait(self, last: int) -> int | None:
        """Wait until the page's content has changed more than `last` times in total, or until the program has ended.

        Returns:
            The total number of changes so far, or None if the program has ended.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._ended or self._number > last)
            return None if self._ended else self._number

    def close(self) -> None:
        """Show in open pages that the program has ended, and stop the server."""
        with self._changed:
            self._ended = True
            self._changed.notify_all()
        if self.is_open:
            time.sleep(_LAST_S)
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


class _Handler(http.server.BaseHTTPRequestHandler):
    """Answers the requests of the page."""

    owner: Site

    def log_message(self, *_: object) -> None:
        """Do not log requests."""

    def do_GET(self) -> None:
        """Send the HTML page, the content of the page from `Site.facts`, a single image or a stream."""
        path = self.path.partition("?")[0].removeprefix("/")
        with contextlib.suppress(OSError):  # the browser may have closed the connection
            if not self._own_name():
                self.send_error(403, "Open the page at the address that the program has printed")
            elif path == "":
                self._send("text/html; charset=utf-8", self.owner.document.read_bytes())
            elif path == "view":
                self._send("application/json", json.dumps(self.owner.asked()).encode())
            elif path.endswith(".mjpg") and path.removesuffix(".mjpg") in self.owner.streams:
                self._stream(path.removesuffix(".mjpg"))
            elif (image := self.owner.still(path)) is not None:
                self._send("image/jpeg", _jpeg(image))
            else:
                self.send_error(404)

    def do_POST(self) -> None:
        """Pass an action of the page to `Site.pressed`."""
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
        """Return whether the request names this server as its host, and not another site."""
        name = ""
        with contextlib.suppress(ValueError):
            name = urllib.parse.urlsplit("//" + self.headers.get("Host", "")).hostname or ""
        if name == self.owner.host or (self.owner.is_local and name in ("localhost", "127.0.0.1", "::1")):
            return True
        with contextlib.suppress(ValueError):  # a server on 0.0.0.0 has all addresses of this computer
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
        while (changed := self.owner.wait(number)) is not None:
            number, image = changed, self.owner.image(stream)
            if image is None or image is shown:
                continue
            shown, data = image, _jpeg(image)
            head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}\r\n\r\n"
            self.wfile.write(head.encode() + data + b"\r\n")
            time.sleep(_INTERVAL_S)


def _jpeg(image: Image) -> bytes:
    """Reduce an image to at most `_WIDEST` pixels in width, and encode it as JPEG."""
    height, width = image.shape[:2]
    if width > _WIDEST:
        image = cv2.resize(image, (_WIDEST, round(height * _WIDEST / width)), interpolation=cv2.INTER_AREA)
    parameters = [cv2.IMWRITE_JPEG_QUALITY, _QUALITY]
    return cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), parameters)[1].tobytes()
