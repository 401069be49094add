"""The dashboard's process: ROS side, emergency stop, page."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

from nicegui import app, ui
from starlette.websockets import WebSocket

from pea_core.params import ParameterError
from pea_runtime.dashboard import stop
from pea_runtime.dashboard.desk import Desk
from pea_runtime.dashboard.door import Door, Guarded
from pea_runtime.dashboard.live import live
from pea_runtime.dashboard.page import Page

STATIC = Path(__file__).parent / "static"

TITLE = "pea dashboard"


@contextlib.contextmanager
def stoppable(desk: Desk, door: Door, port: int) -> Iterator[int]:
    """Serve the emergency stop; its port."""

    def allowed(headers: dict[str, str]) -> bool:
        return door.open_to({name.lower(): value for name, value in headers.items()})

    try:
        server = stop.Server(door.host, port, desk.stop, allowed)
    except OSError as error:
        raise ParameterError(
            f"--port {port - 1}: {port} is for the stop: {error.strerror}"
        ) from None
    with stop.serving(server):
        yield server.server_address[1]


def serve(desk: Desk, door: Door, port: int, stop_port: int) -> None:
    """Serve the page until Ctrl-C."""
    app.add_static_files("/pea-static", STATIC, max_cache_age=0)

    @app.websocket("/live")
    async def _live(socket: WebSocket) -> None:
        await live(socket, desk)

    @app.post("/stop")
    def _stop() -> dict[str, object]:
        return desk.stop()._asdict()

    app.add_middleware(Guarded, door=door)
    ui.run(
        lambda: Page(desk, stop_port) and None,
        host=door.host,
        port=port,
        title=TITLE,
        favicon="🎛",
        dark=None,
        reload=False,
        show=False,
        show_welcome_message=False,
        reconnect_timeout=30.0,
        ws_per_message_deflate=False,  # frames are noise, and the way is short
    )
