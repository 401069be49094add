"""Requests to the dashboard: its stop's server and its door, a view of ``/live``, odd texts.

No input may stop the loop but a whole ``POST /stop`` of nobody else's page: `attempt` sends each as
a page elsewhere would, whatever else it says, over a connection of its own, and looks.
"""

from __future__ import annotations

import atexit
import contextlib
import random
import socket
import time
from collections.abc import Iterator
from functools import cache
from typing import Any

from pea_fuzz import SPECIAL, mutated

SHARE = 0.3

TIMEOUT = 9.0
"""Seconds that an answer may take."""

FOREIGN = b"Origin: http://elsewhere.example\r\n"

PIECES = (
    *SPECIAL,
    *(b"\r\n", b"\r\n\r\n", b"\r", b"POST /stop HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"),
    *(b"Content-Length: 5\r\n", b"Transfer-Encoding: chunked\r\n", b"0\r\n\r\n", b"chunked"),
    *(b"Host: localhost\r\n", b"Origin: null\r\n", b"Cookie: pea_token=x\r\n", b"/stop", b"GET"),
    *(b"Upgrade: websocket\r\nConnection: upgrade\r\n", b"Expect: 100-continue\r\n", b"HTTP/1.0"),
)

REQUESTS = (
    b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n%s\r\n" % FOREIGN,
    b"GET /?token=x HTTP/1.1\r\nHost: localhost\r\n%sCookie: pea_token=y\r\n\r\n" % FOREIGN,
    b"POST /stop HTTP/1.1\r\nHost: 127.0.0.1\r\n%sContent-Length: 4\r\n\r\nbody" % FOREIGN,
    b"POST /stop HTTP/1.1\r\nHost: 127.0.0.1\r\n%s"
    b"Transfer-Encoding: chunked\r\n\r\n4\r\nbody\r\n0\r\n\r\n" % FOREIGN,
    b"OPTIONS /stop HTTP/1.1\r\nHost: 127.0.0.1\r\n%s"
    b"Access-Control-Request-Method: POST\r\n\r\n" % FOREIGN,
)

VIEWS = (b'{"span": 1.0, "end": null, "source": ""}', b'{"span": 0.1, "end": 5, "source": "a"}')


def fuzz(seed: int, n: int) -> Iterator[bytes]:
    """Inputs of a kind each: the first letter says of which."""
    draw = random.Random(seed)
    for _ in range(n):
        kind = draw.choice(b"RRRRVT")
        if kind == b"R"[0]:
            parts = draw.choice((1, 1, 2)) * [draw.choice(REQUESTS)]
            yield b"R" + mutated(draw, b"".join(parts), PIECES)
        elif kind == b"V"[0]:
            yield b"V" + mutated(draw, draw.choice(VIEWS))
        else:
            yield b"T" + mutated(draw, draw.choice(PIECES))


@cache
def served() -> tuple[Any, list[str]]:
    """A stop's server, and what was asked of it."""
    from pea_dashboard import stop, stop_server
    from pea_dashboard.door import Door

    asked: list[str] = []

    def halt() -> Any:
        asked.append("stop")
        return stop.EmergencyStopped(True, "stopped")

    listening = stop_server.listen("127.0.0.1", 0)
    server = stop_server.Server(listening, halt, Door("127.0.0.1", 8642))
    stack = contextlib.ExitStack()
    stack.enter_context(stop_server.serving(server))
    atexit.register(stack.close)
    return server, asked


def attempt(data: bytes) -> None:
    """Read one input."""
    kind, rest = data[:1], data[1:]
    if kind == b"R":
        _request(rest)
    elif kind == b"V":
        from pea_dashboard.live import view_of

        view_of(rest.decode(errors="surrogateescape"))
    else:
        from pea_dashboard.foreign import count, number, plain

        text = rest.decode(errors="surrogateescape")
        count(text)
        number(text)
        plain(text).encode()
        assert plain(text).isprintable()


def _request(data: bytes) -> None:
    server, asked = served()
    with (
        contextlib.suppress(ConnectionError),  # it is closed while this still sends
        socket.create_connection(("127.0.0.1", server.port), TIMEOUT) as connection,
    ):
        connection.sendall(data)
        connection.shutdown(socket.SHUT_WR)  # what is not whole is over
        while connection.recv(65536):
            pass
    while server.busy:  # an answer that nobody takes any more is made nonetheless
        time.sleep(1e-3)
    stopped = bool(asked)
    asked.clear()
    head = data.replace(b"\r\n", b"\n").partition(b"\n\n")[0] + b"\n"
    if stopped and b"\n" + FOREIGN.replace(b"\r", b"") in head and data.count(b"HTTP/1") == 1:
        raise AssertionError("another page has stopped the loop")
