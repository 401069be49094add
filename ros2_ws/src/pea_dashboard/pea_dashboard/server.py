"""The dashboard's process: ROS side, emergency stop, page."""

from __future__ import annotations

import logging

from nicegui import app, ui
from starlette.responses import FileResponse, Response
from starlette.websockets import WebSocket

from pea_dashboard import stop_server
from pea_dashboard.desk import Desk
from pea_dashboard.door import Door, DoorMiddleware
from pea_dashboard.live import live
from pea_dashboard.page import Page

TITLE = "pea dashboard"


def _no_end(record: logging.LogRecord) -> bool:
    """Whether a log line is more than a second Ctrl-C, which cancels what the first waits for."""
    return "CancelledError" not in record.getMessage()


def serve(desk: Desk, door: Door, stop_port: int) -> None:
    """Serve the page until Ctrl-C."""
    # a bar on top of the page while something is fetched would have no name for screen readers
    app.config.quasar_config["loadingBar"]["skipHijack"] = True
    app.add_static_files("/pea-static", stop_server.STATIC, max_cache_age=0)
    ui.add_head_html(stop_server.head(stop_port), shared=True)  # of error pages, too

    @app.websocket("/live")
    async def _live(socket: WebSocket) -> None:
        await live(socket, desk)

    @app.post("/stop")
    def _stop() -> dict[str, object]:
        done = desk.stop()
        return {"safe": done.safe, "text": done.text}

    @app.get("/report")
    def _report() -> Response:
        there = desk.child.report
        return FileResponse(there) if there else Response("no run has ended", 404)

    logging.getLogger("uvicorn.error").addFilter(_no_end)
    word = "This page cannot be shown ({{error}}); the stop works. Load it again."
    app.add_middleware(DoorMiddleware, door=door, fallback=stop_server.bare(stop_port, word))
    ui.run(
        lambda: Page(desk) and None,
        host=door.host,
        port=door.port,
        title=TITLE,
        favicon="🎛",
        dark=None,
        language="en-US",
        reload=False,
        show=False,
        show_welcome_message=False,
        uvicorn_logging_level="error",
        http="h11",  # bounds the head of a request
        proxy_headers=False,
        reconnect_timeout=30.0,
        ws_per_message_deflate=False,  # frames are noise, and the way is short
    )
