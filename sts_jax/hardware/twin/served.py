"""`Served`: a `Twin` behind a pseudo-terminal and an HTTP server, which other processes use like a real sensor."""

import contextlib
import dataclasses
import json
import os
import queue
import select
import socket
import threading
import time
import tty
import urllib.parse
from pathlib import Path

from sts_jax.hardware import web
from sts_jax.hardware.twin.device import Twin, TwinFrame

CAMERA = "/camera"
COMMANDS = ("hold", "release", "clear")  # what the hand can do, see `ObjectScene`
_WAIT_S = 0.1  # longest time until waiting threads notice that they must stop (s)
_CLOSE_S = 1.0  # longest wait for clients when the server is closed (s)
_TICK_S = 0.003  # longest wait for bytes, after which the watchdog is checked (s)
_BUFFER = 1 << 16  # size of a connection's send buffer (bytes). With a larger one, a slow client gets older frames
_KEPT = 32  # largest number of frames that wait for their delivery to a client


class _LedPort:
    """A pseudo-terminal that acts as the serial port of the twin's LED controller. It has any baud rate."""

    def __init__(self, twin: Twin, link: str | os.PathLike | None):
        self._twin = twin
        self._link = None if link is None else Path(link)
        if self._link is not None and self._link.exists() and not self._link.is_symlink():
            raise FileExistsError(f"link is {self._link}, which exists and is not a symbolic link: choose another path")
        # The slave stays open in this process, because reading the master fails while nobody has opened the slave.
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self._name = os.ttyname(self._slave)
        self.device = self._name if self._link is None else str(self._link)
        if self._link is not None:
            try:
                self._link.unlink(missing_ok=True)
                self._link.symlink_to(self._name)
            except OSError:
                self.close()
                raise

    def serve(self, stop: threading.Event) -> None:
        """Answer requests until the event is set."""
        while not stop.is_set():
            readable = select.select([self._master], [], [], _TICK_S)[0]
            data = os.read(self._master, 4096) if readable else b""
            if answer := self._twin.receive(data):
                with contextlib.suppress(BlockingIOError):  # no host reads, and the buffer of the line is full
                    os.write(self._master, answer)

    def close(self) -> None:
        """Close the pseudo-terminal, and remove the symbolic link if there is one."""
        if self._link is not None and self._link.is_symlink() and os.readlink(self._link) == self._name:
            self._link.unlink()
        for descriptor in (self._master, self._slave):
            os.close(descriptor)


class _Server(web.Server):
    """The HTTP server, and the camera, which produces frames while at least one client is connected."""

    def __init__(self, host: str, port: int, twin: Twin, stop: threading.Event):
        self.twin, self.stop = twin, stop
        self.clients: set[queue.Queue[TwinFrame]] = set()  # the frames that wait for their delivery to each client
        super().__init__(host, port, _Handler)

    def produce(self) -> None:
        """Produce frames until the event `stop` is set."""
        twin, index = self.twin, -1
        while not self.stop.is_set():
            if not self.clients:
                self.stop.wait(_TICK_S)
                continue
            # If this thread is late, it skips frames, as a real camera does.
            index = max(index + 1, int((twin.now_s - twin.end_s(0)) * twin.rate))
            while (wait_s := twin.end_s(index) - twin.now_s) > 0:
                if self.stop.wait(wait_s):
                    return
            frame = twin.make(index)
            for client in list(self.clients):
                with contextlib.suppress(queue.Full):  # the client reads too slowly
                    client.put_nowait(frame)


class _Handler(web.Handler):
    server: _Server

    def do_GET(self) -> None:
        if self.path == CAMERA:
            self._stream()
        elif self.path == "/state":
            self._json(200, dataclasses.asdict(self.server.twin.state))
        else:
            self._unknown()

    def do_POST(self) -> None:
        command, _, query = self.path.removeprefix("/").partition("?")
        twin, options = self.server.twin, dict(urllib.parse.parse_qsl(query))
        try:
            if command in COMMANDS and not query:
                self._json(200, dataclasses.asdict(twin.command(command)))
            elif command == "choose" and options.keys() == {"class", "seed"}:
                self._json(200, dataclasses.asdict(twin.choose(options["class"], int(options["seed"]))))
            else:
                self._unknown()
        except (ValueError, OverflowError) as error:
            self._json(400, {"error": str(error)})

    def _unknown(self) -> None:
        posts = [f"POST /{name}" for name in (*COMMANDS, "choose?class=bottle&seed=3")]
        known = [f"GET {CAMERA}", "GET /state", *posts]
        self._json(404, {"error": f"the request {self.command} {self.path} is not one of {', '.join(known)}"})

    def _json(self, code: int, content: dict[str, object]) -> None:
        self.send("application/json", json.dumps(content).encode() + b"\n", code)

    def _stream(self) -> None:
        """Send each frame when it is due. A client that reads too slowly misses frames."""
        server, frames = self.server, queue.Queue[TwinFrame](_KEPT)
        self.request.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER)
        server.clients.add(frames)
        try:
            self.begin_stream()
            while not server.stop.is_set():
                with contextlib.suppress(queue.Empty):
                    exposure, jpeg = frames.get(timeout=_WAIT_S)
                    late_s = server.twin.now_s - exposure.due_s
                    if late_s < 1 / server.twin.rate or frames.empty():
                        time.sleep(max(0.0, -late_s))
                        self.send_frame(jpeg)
        finally:
            server.clients.discard(frames)


class Served(contextlib.AbstractContextManager["Served"]):
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
        self._stop = threading.Event()
        self._web = _Server(host, http_port, twin, self._stop)
        try:
            self._leds = _LedPort(twin, link)
        except OSError:
            self._web.server_close()
            raise
        self.port = self._leds.device  # name of the serial port of the LED controller
        self.url = self._web.url  # URL of the HTTP server, such as `http://127.0.0.1:45253`
        self.camera = self.url + CAMERA  # URL of the camera stream, for `cv2.VideoCapture`
        self._threads = [
            threading.Thread(target=self._web.serve_forever, args=(0.05,), name="twin's HTTP server", daemon=True),
            threading.Thread(target=self._web.produce, name="twin's camera", daemon=True),
            threading.Thread(target=self._leds.serve, args=(self._stop,), name="twin's LED port", daemon=True),
        ]
        for thread in self._threads:
            thread.start()

    @property
    def description(self) -> str:
        """The serial port, the URLs of the server, and whether other machines can connect, in five lines."""
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
        """Stop all threads, close the serial port and the server, and remove the link. Closing twice is allowed."""
        if self._stop.is_set():
            return
        self._stop.set()
        # The threads of the clients must end before Python does, which would otherwise abort the process.
        deadline = time.monotonic() + _CLOSE_S
        while self._web.clients and time.monotonic() < deadline:
            time.sleep(_TICK_S)
        self._web.shutdown()
        self._web.server_close()
        for thread in self._threads:
            thread.join()
        self._leds.close()

    def __exit__(self, *_: object) -> None:
        self.close()
