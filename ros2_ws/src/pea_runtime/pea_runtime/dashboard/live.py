"""Frames for the plots of a browser: 25 a second over a websocket of their own.

New samples come 25 times a second from a loop in one process, and make a frame each; where they
come more often, a frame takes some together.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import time
from typing import Any

from starlette.websockets import WebSocket, WebSocketDisconnect

from pea_runtime.dashboard.desk import Desk
from pea_runtime.dashboard.window import View, errors, look, pack
from pea_runtime.record.read import BagError

FRAME = 0.03
"""Least seconds between two frames."""

AGAIN = 0.005
"""Seconds until it is looked again where nothing new has come."""

SPECTRUM_EVERY = 5
"""Frames from one spectrum to the next."""

SPANS = (1e-4, 600.0)
"""Least and greatest width of a window (s)."""


def view_of(text: str) -> View | None:
    """What a browser asks for; None where it asks for nothing sensible."""
    try:
        asked = json.loads(text)
        span, end = float(asked["span"]), asked["end"]
        if not SPANS[0] <= span <= SPANS[1]:
            return None
        return View(span, None if end is None else float(end), str(asked.get("source", "")))
    except (ValueError, TypeError, KeyError, AttributeError):
        return None


class Frames:
    """Makes the frames of one browser.

    Parameters
    ----------
    desk : Desk
    """

    def __init__(self, desk: Desk) -> None:
        self.desk = desk
        self.view = View()
        self._last: Any = None
        self._count = 0

    def next(self) -> bytes | None:
        """The next frame; None where it would be the same again."""
        desk, view = self.desk, self.view
        head: dict[str, Any] = {"limits": desk.limits, "run": desk.trace.run}
        source: Any = desk.trace
        if view.source:
            try:
                source = desk.recordings.open(view.source)
            except (BagError, OSError) as error:
                return pack({**head, "span": view.span, "word": str(error)}, {})
            head["limits"] = source.limits
        key = (view, source.end, source.first, head["run"])
        if key == self._last:
            return None
        found = look(source, view, desk.period)
        arrays = found.pop("arrays")
        if self._last is None or self._last[0] != view or self._count % SPECTRUM_EVERY == 0:
            arrays["f"], arrays["amplitude"] = errors(source, view)
        self._last = key
        self._count += 1
        return pack({**head, **found}, arrays)


async def live(socket: WebSocket, desk: Desk) -> None:
    """Serve a browser until it leaves."""
    await socket.accept()
    frames = Frames(desk)

    async def listen() -> None:
        while True:
            view = view_of(await socket.receive_text())
            if view is not None:
                frames.view = view

    listening = asyncio.create_task(listen())
    due = time.monotonic()
    try:
        while not listening.done():
            make = asyncio.to_thread if frames.view.source else _now
            frame = await make(frames.next)
            if frame is None:
                await asyncio.sleep(AGAIN)
                continue
            await socket.send_bytes(frame)
            due = max(due + FRAME, time.monotonic())
            await asyncio.sleep(max(due - time.monotonic(), 0.0))
    except (WebSocketDisconnect, RuntimeError):
        pass  # it has left
    finally:
        listening.cancel()
        with contextlib.suppress(asyncio.CancelledError, WebSocketDisconnect, RuntimeError):
            await listening


async def _now(make: Any) -> Any:
    return make()
