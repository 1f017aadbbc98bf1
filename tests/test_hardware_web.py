"""The HTTP server of the pages and of the twin, with raw sockets."""

import contextlib
import http.client
import socket
import struct
import threading
import time

import pytest

from sts_jax.hardware import web

WAIT_S = 30.0


class Handler(web.Handler):
    timeout = 0.3

    def do_GET(self):
        self.send("text/plain", b"hello")

    do_POST = do_GET


@pytest.fixture
def port(monkeypatch):
    monkeypatch.setattr(web, "_MOST", 4)
    server = web.Server("127.0.0.1", 0, Handler)
    thread = threading.Thread(target=server.serve_forever, args=(0.01,))
    thread.start()
    yield server.server_port
    server.shutdown()
    server.server_close()
    thread.join()


def connected(port):
    return contextlib.closing(socket.create_connection(("127.0.0.1", port), timeout=WAIT_S))


def status(port, method="GET", **headers):
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=WAIT_S)
    connection.request(method, "/", headers={"Host": f"localhost:{port}", **headers})
    with contextlib.closing(connection):
        return connection.getresponse().status


@pytest.mark.parametrize(
    ("headers", "code"),
    [
        ({}, 200),
        ({"Host": "127.0.0.1"}, 200),
        ({"Host": "LOCALHOST:80"}, 200),
        ({"Host": "evil.example"}, 403),
        ({"Host": "127.0.0.1.evil.example"}, 403),
        ({"Host": "[localhost"}, 403),
        ({"Host": ""}, 403),
        ({"Origin": "http://localhost:1"}, 403),
        ({"Origin": "null"}, 403),
        ({"Origin": "http://[evil"}, 403),
        ({"Sec-Fetch-Site": "cross-site"}, 403),
    ],
)
@pytest.mark.parametrize("method", ["GET", "POST"])
def test_only_requests_for_its_own_name_and_from_its_own_pages_are_answered(port, method, headers, code):
    assert status(port, method, **headers) == code


def test_a_server_on_all_addresses_has_the_names_of_its_computer():
    server = web.Server("0.0.0.0", 0, Handler)
    thread = threading.Thread(target=server.serve_forever, args=(0.01,))
    thread.start()
    name = socket.gethostname()
    found = [
        status(server.server_port, Host=host)
        for host in (name, f"{name.upper()}.local:80", "192.168.0.1", "evil.example")
    ]
    server.shutdown()
    server.server_close()
    thread.join()
    assert found == [200, 200, 200, 403]


@pytest.mark.parametrize("sent", [b"", b"GET / HTTP/1.1\r\n", b"GET / HTTP/1.1\r\nHost: localhost\r\nA: "])
def test_a_client_that_sends_nothing_or_byte_by_byte_is_disconnected(port, sent):
    with connected(port) as connection:
        connection.sendall(sent)
        deadline = time.monotonic() + WAIT_S
        with contextlib.suppress(OSError):  # the server has closed the connection
            while time.monotonic() < deadline:
                connection.settimeout(0.05)
                with contextlib.suppress(TimeoutError):
                    if connection.recv(1000) == b"":
                        break
                connection.sendall(b"a" if sent else b"")
        assert time.monotonic() < deadline


def test_further_connections_are_closed_until_earlier_ones_end(port):
    with contextlib.ExitStack() as stack:
        silent = [stack.enter_context(connected(port)) for _ in range(20)]
        assert sum(one.recv(1) == b"" for one in silent[4:]) == 16  # at once
        assert [one.recv(1) for one in silent[:4]] == [b""] * 4  # after the time limit
    assert status(port) == 200


def test_resets_and_nonsense_leave_no_trace(port, capfd):
    for sent in (b"GET / HTTP/1.0\r\nHost: localhost\r\n\r\n", b"", b"\x00\xff\r\n\r\n", b"A" * 70000 + b"\r\n"):
        for _ in range(4):
            with connected(port) as connection:
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # a reset
                with contextlib.suppress(OSError):
                    connection.sendall(sent)
        deadline = time.monotonic() + WAIT_S
        code = 0
        while code != 200 and time.monotonic() < deadline:
            with contextlib.suppress(OSError, http.client.HTTPException):
                code = status(port)
        assert code == 200
    assert capfd.readouterr().err == ""
