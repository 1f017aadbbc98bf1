"""A small HTTP server that pages of other sites cannot read or use: the base of the twin's server and of the pages.

`Handler` answers only requests for the server's own name (against DNS rebinding) that no foreign page has sent
(against cross-site requests). `experiments/shared/page.py` derives its handler from it, too.
"""

import contextlib
import http.server
import ipaddress
import socket
import threading
import urllib.parse
from typing import Any

_TIMEOUT_S = 10.0  # longest time of a request, and longest wait for a client that does not read its answer (s)
_MOST = 64  # largest number of connections at a time. One open page has about six


class Server(http.server.ThreadingHTTPServer):
    """A server with a thread per connection. A client that goes away leaves no trace."""

    daemon_threads = True
    request_queue_size = _MOST

    def __init__(self, host: str, port: int, handler: type["Handler"]):
        """Listen on an address, by default on all addresses of this computer. Port 0 selects a free one."""
        host, self._free = host or "0.0.0.0", threading.Semaphore(_MOST)
        try:
            super().__init__((host, port), handler)
        except (OSError, OverflowError) as error:
            raise OSError(f"cannot listen on {host}, port {port} ({error}): choose another host or port") from error
        self.host = host

    @property
    def url(self) -> str:
        """Address of the server, such as `http://127.0.0.1:45253`."""
        return f"http://{self.host}:{self.server_port}"

    @property
    def is_local(self) -> bool:
        """True if only programs on this computer can reach the server."""
        with contextlib.suppress(ValueError):
            return ipaddress.ip_address(self.host).is_loopback
        return self.host == "localhost"

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Print nothing: an error of a connection concerns its client only."""

    def process_request(self, request: Any, client_address: Any) -> None:
        """Answer in a thread, or close the connection if there are too many."""
        if self._free.acquire(blocking=False):
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Answer the requests of a connection."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._free.release()


class Handler(http.server.BaseHTTPRequestHandler):
    """Base of the answers. A subclass defines `do_GET` and `do_POST`, which see only requests that are not foreign."""

    server: Server
    timeout = _TIMEOUT_S

    def handle(self) -> None:
        """Answer a request, unless the client takes too long to send it."""
        limit = threading.Timer(self.timeout, self._stop_reading)
        limit.daemon = True
        limit.start()
        try:
            super().handle()
        finally:
            limit.cancel()

    def _stop_reading(self) -> None:
        with contextlib.suppress(OSError):  # the client has gone
            self.connection.shutdown(socket.SHUT_RD)

    def parse_request(self) -> bool:
        """Refuse a request that names another host, or that a page of another site has sent."""
        if not super().parse_request():
            return False
        host, origin = self.headers.get("Host", ""), self.headers.get("Origin")
        foreign = origin is not None and origin.partition("://")[2] != host
        if self._names_server(host) and not foreign and self.headers.get("Sec-Fetch-Site") != "cross-site":
            return True
        self.send_error(403, "Open the page at the address that the program has printed")
        return False

    def log_message(self, *_: object) -> None:
        """Do not log requests."""

    def send(self, kind: str, data: bytes, code: int = 200) -> None:
        """Send an answer with a content type."""
        self.send_response(code)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(data)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.end_headers()
        self.wfile.write(data)

    def begin_stream(self) -> None:
        """Begin a motion JPEG stream, which `send_frame` continues."""
        self.send_response(200)
        self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        self.close_connection = True

    def send_frame(self, jpeg: bytes) -> None:
        """Send the next JPEG image of the stream."""
        head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n"
        self.wfile.write(head.encode() + jpeg + b"\r\n")

    def _names_server(self, host: str) -> bool:
        name = ""
        with contextlib.suppress(ValueError):
            name = urllib.parse.urlsplit("//" + host).hostname or ""
        if name in ("localhost", self.server.host.lower()) or (self.server.is_local and name in ("127.0.0.1", "::1")):
            return True
        if self.server.host not in ("0.0.0.0", "::"):
            return False
        own = socket.gethostname().lower()
        with contextlib.suppress(ValueError):  # the server has all addresses of this computer
            return name in (own, f"{own}.local") or bool(ipaddress.ip_address(name))
        return False
