"""A client of the browser pages."""

import contextlib
import http.client
import json

from led_simulator import WAIT_S


def ask(page, method, path, body=None, **headers):
    """The status and the content of an answer."""
    with contextlib.closing(http.client.HTTPConnection(page.host, page.port, timeout=WAIT_S)) as connection:
        content = None if body is None else json.dumps(body)
        connection.request(method, path, content, {"Host": f"127.0.0.1:{page.port}", **headers})
        answer = connection.getresponse()
        return answer.status, answer.read()


def streamed(page, path, states):
    """The JPEG image that the page streams for each state."""
    with contextlib.closing(http.client.HTTPConnection(page.host, page.port, timeout=WAIT_S)) as connection:
        connection.request("GET", path)
        answer = connection.getresponse()
        for state in states:
            page.show(state)
            head = [answer.readline() for _ in range(4)]
            assert head[0] == b"--frame\r\n"
            yield answer.read(int(head[2].split(b":")[1]))
            assert answer.readline() == b"\r\n"
