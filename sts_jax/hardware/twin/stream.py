"""The HTTP server of a `Twin` (a simulated sensor).

The server sends the camera stream (motion JPEG) and the state of the twin, and takes commands.
"""

import contextlib
import dataclasses
import http.server
import json
import socket
import threading
import time
import urllib.parse
from collections import deque
from typing import Any

from sts_jax.hardware.twin import faults
from sts_jax.hardware.twin.device import Made, Twin

CAMERA = "/camera"
COMMANDS = ("hold", "release", "clear")
_BOUNDARY = "frame"
_WAIT_S = 0.1  # longest time until waiting threads notice that they must stop (s)
_SEND_S = 10.0  # longest wait for a client that reads nothing (s)
_BUFFER = 1 << 16  # size of a connection's send buffer (bytes). With a larger one, a slow client gets older frames
_KEPT = 32  # largest number of frames that wait for their delivery


class CameraThread:
    """A thread that produces the frames of a `Twin` (a simulated sensor) while at least one client is connected.

    The frame rate is `Twin.rate`.
    """

    def __init__(self, twin: Twin):
        """Start the thread."""
        self._twin = twin
        self._made: deque[Made] = deque(maxlen=_KEPT)
        self._changed = threading.Condition()
        self._clients = 0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="twin's camera", daemon=True)
        self._thread.start()

    @property
    def stopped(self) -> bool:
        """True after `close` was called."""
        return self._stop.is_set()

    def join(self) -> None:
        """Register a client. Frames are produced while at least one client is registered."""
        with self._changed:
            self._clients += 1
            self._changed.notify_all()

    def leave(self) -> None:
        """Remove a client that `join` has registered."""
        with self._changed:
            self._clients -= 1

    def following(self, index: int) -> Made | None:
        """Return the frame that a client receives next. If no such frame exists yet, wait for it, at most 0.1 s.

        Args:
            index: Number of the frame that the client received last, or -1.

        Returns:
            The newest frame after `index` whose delivery time `due_s` has been reached. If the delivery times of all
            frames after `index` are in the future, the result is the first of these frames. The caller must then wait
            until the delivery time before it sends the frame. If no frame after `index` exists, the result is None.
        """
        with self._changed:
            later = [made for made in self._made if made.exposure.index > index]
            if not later:
                self._changed.wait(_WAIT_S)
                later = [made for made in self._made if made.exposure.index > index]
        now = self._twin.now_s
        due = [made for made in later if made.exposure.due_s <= now]
        return due[-1] if due else later[0] if later else None

    def close(self) -> None:
        """Stop the thread."""
        self._stop.set()
        with self._changed:
            self._changed.notify_all()
        self._thread.join()

    def _run(self) -> None:
        index = -1
        while not self._stop.is_set():
            with self._changed:
                if not self._clients:
                    self._changed.wait(_WAIT_S)
                    continue
            # If this thread is late, it skips frames, as a real camera does.
            index = max(index + 1, self._newest(self._twin.now_s))
            while (wait_s := self._twin.end_s(index) - self._twin.now_s) > 0:
                if self._stop.wait(wait_s):
                    return
            made = self._twin.make(index)
            if made is not None:
                with self._changed:
                    self._made.append(made)
                    self._changed.notify_all()

    def _newest(self, now_s: float) -> int:
        """The number of the frame whose exposure ended last."""
        return int((now_s - self._twin.end_s(0)) * self._twin.rate)


class WebServer(http.server.ThreadingHTTPServer):
    """The HTTP server of a `Twin` (a simulated sensor).

    The server sends the camera stream and the twin's state. A client can send a command, or request a simulated fault.
    """

    daemon_threads = False  # `server_close` waits for the threads of all connections
    allow_reuse_address = True

    def __init__(self, address: tuple[str, int], twin: Twin, camera: CameraThread, inject: Any):
        """Bind the address.

        Args:
            address: Host and TCP port. Port 0 selects a free one.
            twin: Twin that executes the commands.
            camera: Source of the frames.
            inject: Function that is called with each requested `Fault`.
        """
        self.twin = twin
        self.camera = camera
        self.inject = inject
        self.connections: set[socket.socket] = set()
        self.streams: set[socket.socket] = set()  # connections that receive frames
        super().__init__(address, _Handler)

    def drop(self) -> None:
        """Close all connections that receive the camera stream."""
        _shut_down(self.streams)

    def server_close(self) -> None:
        """Close the server and all connections, and wait until their threads have ended."""
        _shut_down(self.connections)
        super().server_close()


def _shut_down(connections: set[socket.socket]) -> None:
    for connection in list(connections):
        with contextlib.suppress(OSError):  # it is closed already
            connection.shutdown(socket.SHUT_RDWR)


class _Handler(http.server.BaseHTTPRequestHandler):
    server: WebServer
    timeout = _SEND_S

    def do_GET(self) -> None:
        """Send the camera's frames (`/camera`) or the state (`/state`)."""
        match self.path:
            case "/camera":
                self._stream()
            case "/state":
                self._json(200, dataclasses.asdict(self.server.twin.state))
            case _:
                self._unknown()

    def do_POST(self) -> None:
        """Execute a command (`/hold`, `/release`, `/clear`), or inject a fault (`/fault?kind=...`)."""
        url = urllib.parse.urlsplit(self.path)
        try:
            if url.path[1:] in COMMANDS:
                self._json(200, dataclasses.asdict(self.server.twin.command(url.path[1:])))
            elif url.path == "/fault":
                query: dict[str, Any] = dict(urllib.parse.parse_qsl(url.query))
                given = {name: kind(query[name]) for name, kind in _FAULT_FIELDS.items() if name in query}
                self.server.inject(faults.Fault(**given))
                self._json(200, given)
            else:
                self._unknown()
        except (TypeError, ValueError) as error:
            self._json(400, {"error": str(error)})

    def log_message(self, format: str, *args: Any) -> None:
        """Ignore the message, so that the server does not log requests."""

    def _unknown(self) -> None:
        known = [f"GET {CAMERA}", "GET /state", *(f"POST /{name}" for name in COMMANDS), "POST /fault?kind="]
        self._json(404, {"error": f"the request {self.command} {self.path} is not one of {', '.join(known)}"})

    def _json(self, code: int, content: dict[str, Any]) -> None:
        body = json.dumps(content).encode() + b"\n"
        self.send_response(code)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def _stream(self) -> None:
        """Send each frame when it is due. A client that reads too slowly misses frames."""
        camera, twin = self.server.camera, self.server.twin
        index = -1
        self.send_response(200)
        self.send_header("Content-Type", f"multipart/x-mixed-replace; boundary={_BOUNDARY}")
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        camera.join()
        self.server.streams.add(self.connection)
        try:
            while not camera.stopped:
                made = camera.following(index)
                if made is None:
                    continue
                time.sleep(max(0.0, made.exposure.due_s - twin.now_s))
                head = f"--{_BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(made.jpeg)}\r\n\r\n"
                self.wfile.write(head.encode() + made.jpeg + b"\r\n")
                index = made.exposure.index
        except OSError:
            pass  # the client has gone
        finally:
            self.server.streams.discard(self.connection)
            camera.leave()
            self.close_connection = True

    def setup(self) -> None:
        """Register the connection, and limit its send buffer."""
        self.server.connections.add(self.request)
        self.request.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER)
        super().setup()

    def finish(self) -> None:
        """Remove the connection from the server's set of connections."""
        self.server.connections.discard(self.request)
        with contextlib.suppress(OSError):  # the client has gone
            super().finish()


_FAULT_FIELDS = {"kind": str, "count": int, "seconds": float}
