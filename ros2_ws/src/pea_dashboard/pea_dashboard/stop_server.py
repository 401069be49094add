"""Serves the emergency stop: ``POST /stop``, and a page with nothing but its button."""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Callable, Iterator
from html import escape
from pathlib import Path

import uvicorn
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import HTMLResponse, JSONResponse
from starlette.routing import Route

from pea_dashboard.door import Door, DoorMiddleware
from pea_dashboard.stop import EmergencyStopped

STATIC = Path(__file__).parent / "static"

PATIENCE = 5.0
"""Seconds that the server has to begin, and to end."""

HEADERS = 2**14
"""Bytes of a request's head, at most."""


def listen(host: str, port: int) -> socket.socket:
    """A socket that listens.

    Raises
    ------
    OSError
        The address is not to be had.
    """
    family, kind, number, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    made = socket.socket(family, kind, number)
    try:
        made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        made.bind(address)
        made.listen(128)
    except OSError:
        made.close()
        raise
    return made


def head(port: int) -> str:
    """What a page needs in its head for the button: everything, whatever else is in the page."""
    script = (STATIC / "stop.js").read_text()
    style = (STATIC / "stop.css").read_text()
    return (
        f'<meta name="pea-stop-port" content="{port}"><style>{style}</style>'
        f"<script>{script}</script>"
    )


def bare(port: int, word: str) -> str:
    """A page with the button, and one sentence."""
    return (
        '<!DOCTYPE html><html lang="en"><meta charset="utf-8"><title>pea stop</title>'
        f'<meta name="viewport" content="width=device-width">{head(port)}'
        f'<body style="font-family: system-ui; padding: 6rem 1rem">{escape(word)}</body></html>'
    )


class Server:
    """Serves the emergency stop in a thread of its own.

    Parameters
    ----------
    listening : socket
        Where it listens.
    stop : callable
    door : Door
    """

    def __init__(
        self, listening: socket.socket, stop: Callable[[], EmergencyStopped], door: Door
    ) -> None:
        self.listening = listening
        self.port = int(listening.getsockname()[1])
        page = bare(self.port, "The emergency stop of pea dashboard.")

        def halt(request: Request) -> JSONResponse:
            origin = request.headers.get("origin")  # let in by the door
            allow = {
                "Access-Control-Allow-Origin": origin or "",
                "Access-Control-Allow-Credentials": "true",
            }
            done = stop()
            answer = {"safe": done.safe, "text": done.text}
            return JSONResponse(answer, headers=allow if origin else {})

        app = Starlette(
            routes=[
                Route("/stop", halt, methods=["POST"]),
                Route("/", lambda request: HTMLResponse(page)),
            ],
            middleware=[Middleware(DoorMiddleware, door=door)],
        )
        self._server = uvicorn.Server(
            uvicorn.Config(
                app,
                http="h11",
                ws="none",
                loop="asyncio",
                lifespan="off",
                log_config=None,
                log_level="critical",
                proxy_headers=False,
                timeout_graceful_shutdown=1,
                h11_max_incomplete_event_size=HEADERS,
            )
        )

    def run(self) -> None:
        """Serve until `close`."""
        self._server.run([self.listening])

    @property
    def busy(self) -> bool:
        """Whether a request is being answered, or may come on a connection that there is."""
        state = self._server.server_state
        return bool(state.tasks or state.connections)

    def close(self) -> None:
        """End serving."""
        self._server.should_exit = True


@contextlib.contextmanager
def serving(server: Server) -> Iterator[None]:
    """Serve in a thread."""
    thread = threading.Thread(target=server.run, name="stop", daemon=True)
    thread.start()
    try:
        yield
    finally:
        server.close()
        thread.join(PATIENCE)
        server.listening.close()
