"""A loopback server of motion JPEG with faults on request. Each frame shows its number in blocks that survive JPEG."""

import contextlib
import http.server
import threading
import time

import cv2
import numpy as np

SIZE = (160, 120)  # pixels, width and height
_BITS, _COLUMNS = 16, 4


def draw(number, size=SIZE):
    """A BGR image that shows a number as 4 x 4 blocks, dark for 0 and light for 1."""
    bits = np.array([255 if number >> bit & 1 else 60 for bit in range(_BITS)], np.uint8).reshape(-1, _COLUMNS)
    return cv2.resize(np.repeat(bits[..., None], 3, 2), size, interpolation=cv2.INTER_NEAREST)


def number_of(image):
    """The number that `draw` has drawn."""
    height, width = image.shape[0] // 4, image.shape[1] // 4
    centres = image[height // 2 :: height, width // 2 :: width].mean(-1)[:4, :4].ravel()
    return sum(1 << bit for bit, value in enumerate(centres) if value > 157)


def jpeg(image):
    return cv2.imencode(".jpg", image)[1].tobytes()


class MotionJpeg:
    """The server. `mode` is read before each frame.

    live: numbered frames. skip: numbered frames, without those in `skipped`. repeat: the last frame again. black,
    small: black or smaller frames. damaged: incomplete frames. stall: none. close: the connection is closed.
    hang, missing, text: requests get no answer, status 404, or a text.
    """

    def __init__(self, fps=50, colour=None):
        self.fps, self.colour = fps, colour
        self.mode, self.skipped, self.served = "live", set(), {}
        self.number = 0
        self.port = 0
        self.start()

    @property
    def url(self):
        return f"http://127.0.0.1:{self.port}/video"

    def start(self):
        """Listen, at the port of the last time if there is one."""
        server = self

        class Handler(http.server.BaseHTTPRequestHandler):
            def log_message(self, *args):
                pass

            def do_GET(self):
                with contextlib.suppress(OSError):
                    server.answer(self)

        self.running = True
        self.http = http.server.ThreadingHTTPServer(("127.0.0.1", self.port), Handler)
        self.port = self.http.server_port
        self.thread = threading.Thread(target=self.http.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
        self.thread.start()

    def stop(self):
        """Close all connections and refuse new ones."""
        self.running = False
        self.http.shutdown()
        self.http.server_close()
        self.thread.join()

    def answer(self, request):
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
            data = self._frame()
            self.served.setdefault(self.number, time.monotonic())
            head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}\r\n\r\n".encode()
            request.wfile.write(head + data + b"\r\n")

    def _pause(self, mode):
        while self.running and self.mode == mode:
            time.sleep(0.01)

    def _frame(self):
        if self.colour is not None:  # with a corner that changes
            image = np.full((SIZE[1], SIZE[0], 3), self.colour, np.uint8)
            image[:16, :16] = 60 + self.number % 2 * 100
            return jpeg(image)
        match self.mode:
            case "black":
                return jpeg(np.zeros((SIZE[1], SIZE[0], 3), np.uint8))
            case "small":
                return jpeg(draw(self.number, (SIZE[0] // 2, SIZE[1] // 2)))
            case "damaged":
                data = jpeg(draw(self.number))
                return data[: len(data) // 2]
        return jpeg(draw(self.number))
