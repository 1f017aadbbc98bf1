"""`Served`: a server for a `Twin` (a simulated sensor), whose serial port and camera other processes can open."""

import ipaddress
import os
import threading
import time
from types import TracebackType

from sts_jax.hardware.twin import faults
from sts_jax.hardware.twin.device import Twin
from sts_jax.hardware.twin.port import LedPort
from sts_jax.hardware.twin.stream import CAMERA, CameraThread, WebServer

_OPERATE_S = 0.05  # period with which `release_every` is checked (s)


class Served:
    """A running server through which other processes use a `Twin` (a simulated sensor) like a real sensor.

    ```python
    body = sts_jax.objects.make(jax.random.key(0), "bottle")
    with Twin(ObjectScene(body)) as twin, Served(twin) as served:
        print(served.description)  # the addresses for other processes
        input("Press Enter to stop.")
    ```

    The server runs in threads of this process. The serial port, the camera, the rendering, the HTTP server and each
    HTTP connection have a thread of their own. If the argument `release_every` of `Twin` is given, one more thread
    holds and releases the object at random times. `close` stops all threads.
    """

    def __init__(
        self,
        twin: Twin,
        *,
        link: str | os.PathLike | None = None,
        host: str = "127.0.0.1",
        http_port: int = 0,
    ):
        """Start to serve the twin. The clock of the twin becomes `time.monotonic`.

        Args:
            twin: Twin whose virtual clock has not advanced yet.
            link: Path at which a symbolic link to the serial port is made, so that the port has a fixed name. Default:
                no link.
            host: Address on which the HTTP server listens. If `host` is not the loopback interface, other machines can
                connect without a password.
            http_port: TCP port of the HTTP server. 0 selects a free one.

        Raises:
            RuntimeError: The virtual clock of the twin has advanced.
            OSError: `host`, `http_port` or `link` cannot be used. The message names the value that cannot be used.
        """
        twin.run_on(time.monotonic)
        self._twin = twin
        self._camera = CameraThread(twin)
        try:
            self._web = WebServer((host, http_port), twin, self._camera, self.inject)
        except OSError as error:
            self._camera.close()
            raise type(error)(
                f"cannot listen on {host}, port {http_port} ({error}): choose another host or http_port"
            ) from error
        try:
            self._leds = LedPort(twin, link)
        except OSError:
            self._web.server_close()
            self._camera.close()
            raise
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
        host, port = self._web.server_address[:2]
        return f"http://{host!s}:{port}"

    @property
    def camera(self) -> str:
        """URL of the camera stream, for `cv2.VideoCapture`."""
        return self.url + CAMERA

    @property
    def description(self) -> str:
        """A text of five lines: the serial port, the URLs of the server, and whether other machines can connect."""
        host = str(self._web.server_address[0])
        reach = (
            f"{host} is the loopback interface: only this machine can connect."
            if ipaddress.ip_address(host).is_loopback
            else f"Listening on {host}: OTHER MACHINES CAN CONNECT, without a password."
        )
        return (
            f"LED controller: {self.port}\n"
            f"camera:         {self.camera}\n"
            f"state:          {self.url}/state\n"
            f"commands:       curl -X POST {self.url}/hold (release, clear)\n{reach}"
        )

    def inject(self, fault: faults.Fault) -> None:
        """Simulate a fault of the camera, the LED controller or a connection. `Fault` describes all kinds."""
        if fault.kind in faults.DEVICE_KINDS:
            self._twin.inject(fault)
        elif fault.kind == "drop":
            self._web.drop()
        else:
            self._leds.inject(fault)

    def close(self) -> None:
        """Stop all threads, close the serial port and all sockets, and remove the symbolic link to the port.

        Closing twice is allowed.
        """
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
