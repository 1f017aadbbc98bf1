"""An emulated camera: a local server that sends motion JPEG and can produce faults, such as repeated frames.

Each frame shows its number as dark and light blocks, which remain readable after the JPEG compression.
"""

import contextlib
import http.server
import threading
import time

import cv2
import numpy as np
from jaxtyping import UInt8

SIZE = (160, 120)  # pixels, width and height
_BITS, _COLUMNS = 16, 4

Image = UInt8[np.ndarray, "height width 3"]


def draw(number: int, size: tuple[int, int] = SIZE) -> Image:
    """Draw a number as 4 x 4 blocks, one for each bit, dark for 0 and light for 1.

    Args:
        number: The number, of which the lowest 16 bits are drawn.
        size: Width and height of the image (pixels).

    Returns:
        The BGR image.
    """
    bits = np.array([255 if number >> bit & 1 else 60 for bit in range(_BITS)], np.uint8).reshape(-1, _COLUMNS)
    return np.asarray(cv2.resize(np.repeat(bits[..., None], 3, 2), size, interpolation=cv2.INTER_NEAREST))


def number_of(image: Image) -> int:
    """Read the number that an image from `draw` shows as dark and light blocks."""
    height, width = image.shape[0] // 4, image.shape[1] // 4
    centres = image[height // 2 :: height, width // 2 :: width].mean(-1)[:4, :4].ravel()
    return sum(1 << bit for bit, value in enumerate(centres) if value > 157)


def jpeg(image: Image) -> bytes:
    """Encode a BGR image as a JPEG file."""
    return cv2.imencode(".jpg", image)[1].tobytes()


class MotionJpeg:
    """A server of a motion JPEG stream. Its attribute `mode` selects a fault, and may change at any time.

    The following modes apply to each frame:

    - `live`: send numbered frames.
    - `skip`: leave out the frames whose numbers are in the attribute `skipped`.
    - `repeat`: send the last frame again.
    - `black`: send black frames.
    - `small`: send frames of half the width and height.
    - `damaged`: send incomplete frames.
    - `stall`: send nothing, and keep the connection open.
    - `held`: keep the frames back, and send them all at once when the mode changes.
    - `close`: close the connection.

    The following modes apply to new requests only:

    - `hang`: send no answer.
    - `missing`: answer with status 404.
    - `text`: answer with a text instead of the stream.

    Args:
        fps: Frames per second.
        colour: BGR colour of all frames, except for a corner that alternates between two greys. None: the frames show
            their numbers. If a colour is set, the modes `black`, `small` and `damaged` have no effect.
        size: Width and height of the frames (pixels).
    """

    def __init__(self, fps: float = 50, colour: tuple[int, int, int] | None = None, size: tuple[int, int] = SIZE):
        self.fps, self.colour, self.size = fps, colour, size
        self.mode = "live"
        self.skipped: set[int] = set()
        self.served: dict[int, float] = {}
        self.number = 0
        self.port = 0
        self._last = b""
        self.start()

    @property
    def url(self) -> str:
        """The address of the stream."""
        return f"http://127.0.0.1:{self.port}/video"

    def start(self) -> None:
        """Listen for requests. If the server was stopped before, it listens at its previous port again."""
        server = self

        class Handler(http.server.BaseHTTPRequestHandler):
            def log_message(self, *args: object) -> None:
                pass

            def do_GET(self) -> None:
                with contextlib.suppress(OSError):
                    server.answer(self)

        self.running = True
        self.http = http.server.ThreadingHTTPServer(("127.0.0.1", self.port), Handler)
        self.port = self.http.server_port
        self.thread = threading.Thread(target=self.http.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
        self.thread.start()

    def stop(self) -> None:
        """Close all connections and refuse new ones."""
        self.running = False
        self.http.shutdown()
        self.http.server_close()
        self.thread.join()

    def answer(self, request: http.server.BaseHTTPRequestHandler) -> None:
        """Answer a request for the stream in the way that the attribute `mode` selects.

        Frames are sent until the server stops or `mode` is set to `close`. In the modes `hang`, `missing` and `text`,
        no frames are sent.
        """
        if self.mode == "hang":
            self._pause("hang")
            return
        if self.mode == "missing":
            request.send_error(404)
            return
        request.send_response(200)
        kind = "text/html" if self.mode == "text" else "multipart/x-mixed-replace; boundary=frame"
        request.send_header("Content-Type", kind)
        request.end_headers()
        if self.mode == "text":
            request.wfile.write(b"<html>no video</html>")
            return
        due = time.monotonic()
        held = b""
        while self.running and self.mode != "close":
            if self.mode == "stall":
                self._pause("stall")
                due = time.monotonic()
            due += 1 / self.fps
            time.sleep(max(due - time.monotonic(), 0))
            if self.mode != "repeat":
                self.number += 1
            if self.mode == "skip" and self.number in self.skipped:
                continue
            if self.mode != "repeat" or not self._last:
                self._last = self._frame()
            self.served.setdefault(self.number, time.monotonic())
            head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(self._last)}\r\n\r\n".encode()
            held += head + self._last + b"\r\n"
            if self.mode != "held":
                request.wfile.write(held)
                held = b""

    def _pause(self, mode: str) -> None:
        while self.running and self.mode == mode:
            time.sleep(0.01)

    def _frame(self) -> bytes:
        width, height = self.size
        if self.colour is not None:  # the corner alternates, because identical frames would count as frozen
            image = np.full((height, width, 3), self.colour, np.uint8)
            image[:16, :16] = 60 + self.number % 2 * 100
            return jpeg(image)
        match self.mode:
            case "black":
                return jpeg(np.zeros((height, width, 3), np.uint8))
            case "small":
                return jpeg(draw(self.number, (width // 2, height // 2)))
            case "damaged":
                data = jpeg(draw(self.number, self.size))
                return data[: len(data) // 2]
        return jpeg(draw(self.number, self.size))
