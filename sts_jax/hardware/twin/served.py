"""`Served`: a `Twin` behind a pseudo-terminal and an HTTP server, which other processes use like a real sensor."""

import contextlib
import dataclasses
import json
import os
import select
import socket
import termios
import threading
import time
import tty
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType

from sts_jax.hardware import web
from sts_jax.hardware.twin.device import Twin, TwinFrame

CAMERA = "/camera"
COMMANDS = ("hold", "release", "clear")
_WAIT_S = 0.1  # longest time until waiting threads notice that they must stop (s)
_TICK_S = 0.003  # longest wait for bytes, after which the watchdog is checked (s)
_OPERATE_S = 0.05  # period with which `release_every` is checked (s)
_SPEED = termios.B115200  # baud rate of the protocol
_BUFFER = 1 << 16  # size of a connection's send buffer (bytes). With a larger one, a slow client gets older frames
_KEPT = 32  # largest number of frames that wait for their delivery


class LedPort:
    """A pseudo-terminal that acts as the serial port of the twin's LED controller. A thread answers the requests.

    As on a real serial line, a host at another rate than 115200 baud receives unreadable bytes.
    """

    def __init__(self, twin: Twin, link: str | os.PathLike | None = None):
        """Open the pseudo-terminal and start the thread. `link` is as in `Served`."""
        self._twin = twin
        self._link = None if link is None else Path(link)
        if self._link is not None and self._link.exists() and not self._link.is_symlink():
            raise FileExistsError(f"link is {self._link}, which exists and is not a symbolic link: choose another path")
        # The slave stays open in this process, because reading the master fails while nobody has opened the slave.
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self._name = os.ttyname(self._slave)
        if self._link is not None:
            try:
                self._link.unlink(missing_ok=True)
                self._link.symlink_to(self._name)
            except OSError:
                self._close()
                raise
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._serve, name="twin's LED port", daemon=True)
        self._thread.start()

    @property
    def device(self) -> str:
        """Path of the port: the symbolic link if there is one, else the pseudo-terminal."""
        return self._name if self._link is None else str(self._link)

    def close(self) -> None:
        """End the thread, close the pseudo-terminal, and remove the symbolic link if there is one."""
        self._stop.set()
        self._thread.join()
        self._close()

    def _close(self) -> None:
        if self._link is not None and self._link.is_symlink() and os.readlink(self._link) == self._name:
            self._link.unlink()
        for descriptor in (self._master, self._slave):
            os.close(descriptor)

    def _serve(self) -> None:
        while not self._stop.is_set():
            readable = select.select([self._master], [], [], _TICK_S)[0]
            self._send(self._twin.receive())
            if readable:
                with contextlib.suppress(BlockingIOError):
                    data = os.read(self._master, 4096)
                    attributes = termios.tcgetattr(self._slave)
                    right_speed = attributes[4] == attributes[5] == _SPEED
                    self._send(self._twin.receive(data) if right_speed else b"\xff" * len(data))

    def _send(self, data: bytes) -> None:
        """Send bytes to the host. If no host reads and the buffer of the line is full, they are lost."""
        if data:
            with contextlib.suppress(BlockingIOError):
                os.write(self._master, data)


class CameraThread:
    """A thread that produces the frames of a twin while at least one client is connected."""

    def __init__(self, twin: Twin):
        """Start the thread."""
        self.twin = twin
        self._frames: deque[TwinFrame] = deque(maxlen=_KEPT)
        self._changed = threading.Condition()
        self._clients = 0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="twin's camera", daemon=True)
        self._thread.start()

    @property
    def stopped(self) -> bool:
        """True after `close` was called."""
        return self._stop.is_set()

    @contextlib.contextmanager
    def client(self) -> Iterator[None]:
        """Register a client for the duration of the `with` block."""
        with self._changed:
            self._clients += 1
            self._changed.notify_all()
        try:
            yield
        finally:
            with self._changed:
                self._clients -= 1

    def following(self, index: int) -> TwinFrame | None:
        """Return the newest frame after a number that is due, or else the first one that will be due.

        If there is none yet, the method waits for at most 0.1 s and may return None.
        """
        with self._changed:
            later = [frame for frame in self._frames if frame.exposure.index > index]
            if not later:
                self._changed.wait(_WAIT_S)
                later = [frame for frame in self._frames if frame.exposure.index > index]
        now = self.twin.now_s
        due = [frame for frame in later if frame.exposure.due_s <= now]
        return due[-1] if due else later[0] if later else None

    def close(self) -> None:
        """Stop the thread."""
        self._stop.set()
        with self._changed:
            self._changed.notify_all()
        self._thread.join()

    def _run(self) -> None:
        twin, index = self.twin, -1
        while not self._stop.is_set():
            with self._changed:
                if not self._clients:
                    self._changed.wait(_WAIT_S)
                    continue
            # If this thread is late, it skips frames, as a real camera does.
            index = max(index + 1, int((twin.now_s - twin.end_s(0)) * twin.rate))
            while (wait_s := twin.end_s(index) - twin.now_s) > 0:
                if self._stop.wait(wait_s):
                    return
            frame = twin.make(index)
            with self._changed:
                self._frames.append(frame)
                self._changed.notify_all()


class _Server(web.Server):
    daemon_threads = False  # `server_close` waits for the threads of all connections

    def __init__(self, host: str, port: int, camera: CameraThread):
        self.camera = camera
        self.connections: set[socket.socket] = set()
        super().__init__(host, port, _Handler)

    def server_close(self) -> None:
        for connection in list(self.connections):
            with contextlib.suppress(OSError):  # it is closed already
                connection.shutdown(socket.SHUT_RDWR)
        super().server_close()


class _Handler(web.Handler):
    server: _Server

    def do_GET(self) -> None:
        if self.path == CAMERA:
            self._stream()
        elif self.path == "/state":
            self._json(200, dataclasses.asdict(self.server.camera.twin.state))
        else:
            self._unknown()

    def do_POST(self) -> None:
        command = self.path.removeprefix("/")
        if command not in COMMANDS:
            self._unknown()
            return
        try:
            self._json(200, dataclasses.asdict(self.server.camera.twin.command(command)))
        except ValueError as error:
            self._json(400, {"error": str(error)})

    def _unknown(self) -> None:
        known = [f"GET {CAMERA}", "GET /state", *(f"POST /{name}" for name in COMMANDS)]
        self._json(404, {"error": f"the request {self.command} {self.path} is not one of {', '.join(known)}"})

    def _json(self, code: int, content: dict[str, object]) -> None:
        self.send("application/json", json.dumps(content).encode() + b"\n", code)

    def _stream(self) -> None:
        """Send each frame when it is due. A client that reads too slowly misses frames."""
        camera, index = self.server.camera, -1
        with camera.client(), contextlib.suppress(OSError):  # the client may go away
            self.begin_stream()
            while not camera.stopped:
                frame = camera.following(index)
                if frame is not None:
                    time.sleep(max(0.0, frame.exposure.due_s - camera.twin.now_s))
                    self.send_frame(frame.jpeg)
                    index = frame.exposure.index

    def setup(self) -> None:
        self.server.connections.add(self.request)
        self.request.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER)
        super().setup()

    def finish(self) -> None:
        self.server.connections.discard(self.request)
        with contextlib.suppress(OSError):  # the client has gone
            super().finish()


class Served:
    """A running server through which other processes use a `Twin` like a real sensor.

    ```python
    body = sts_jax.objects.make(jax.random.key(0), "bottle")
    with Twin(ObjectScene(body)) as twin, Served(twin) as served:
        print(served.description)  # the addresses for other processes
        input("Press Enter to stop.")
    ```
    """

    def __init__(
        self, twin: Twin, *, link: str | os.PathLike | None = None, host: str = "127.0.0.1", http_port: int = 0
    ):
        """Start to serve the twin. The clock of the twin becomes `time.monotonic`.

        Args:
            twin: Twin whose virtual clock has not advanced yet.
            link: Path at which a symbolic link to the serial port is made, so that the port has a fixed name. An
                existing link is replaced. Default: no link.
            host: Address on which the HTTP server listens. If it is not the loopback interface, other machines can
                connect without a password.
            http_port: TCP port of the HTTP server. 0 selects a free one.
        """
        twin.run_on(time.monotonic)
        self._twin = twin
        with contextlib.ExitStack() as opened:
            self._camera = CameraThread(twin)
            opened.callback(self._camera.close)
            self._web = _Server(host, http_port, self._camera)
            opened.callback(self._web.server_close)
            self._leds = LedPort(twin, link)
            opened.pop_all()
        twin.scene.start(twin.blender)
        self._stop = threading.Event()
        self._threads = [
            threading.Thread(target=self._web.serve_forever, args=(0.05,), name="twin's HTTP server", daemon=True),
            threading.Thread(target=self._operate, name="twin's hand", daemon=True),
        ]
        for thread in self._threads:
            thread.start()

    @property
    def port(self) -> str:
        """Name of the serial port of the LED controller."""
        return self._leds.device

    @property
    def url(self) -> str:
        """URL of the HTTP server, such as `http://127.0.0.1:45253`."""
        return self._web.url

    @property
    def camera(self) -> str:
        """URL of the camera stream, for `cv2.VideoCapture`."""
        return self.url + CAMERA

    @property
    def description(self) -> str:
        """A text of five lines: the serial port, the URLs of the server, and whether other machines can connect."""
        reach = (
            f"{self._web.host} is the loopback interface: only this machine can connect."
            if self._web.is_local
            else f"Listening on {self._web.host}: OTHER MACHINES CAN CONNECT, without a password."
        )
        return (
            f"LED controller: {self.port}\n"
            f"camera:         {self.camera}\n"
            f"state:          {self.url}/state\n"
            f"commands:       curl -X POST {self.url}/hold (release, clear)\n{reach}"
        )

    def close(self) -> None:
        """Stop all threads, close the serial port and all sockets, and remove the link. Closing twice is allowed."""
        if self._stop.is_set():
            return
        self._stop.set()
        self._camera.close()
        self._web.shutdown()
        self._web.server_close()
        self._leds.close()
        self._twin.scene.close()
        for thread in self._threads:
            thread.join()

    def __enter__(self) -> "Served":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _operate(self) -> None:
        while not self._stop.wait(_OPERATE_S):
            self._twin.operate()
