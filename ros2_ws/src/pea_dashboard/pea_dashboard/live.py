"""Frames for the plots of a browser: 25 a second over a websocket of their own.

New samples come 25 times a second from a loop in one process, and make a frame each; where they
come more often, a frame takes some together.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import time
from collections.abc import Callable
from typing import Any

from starlette.websockets import WebSocket, WebSocketDisconnect

from pea_dashboard.desk import Desk
from pea_dashboard.foreign import number, plain
from pea_dashboard.window import SIDES, SPECTRA, View, along, chosen, look, over_frequency, pack

FRAME = 0.03
"""Least seconds between two frames."""

AGAIN = 0.005
"""Seconds until it is looked again where nothing new has come."""

BEAT = 1.0
"""Seconds after which a browser is told that there is nothing new."""

SPECTRUM_EVERY = 5
"""Frames from one spectrum to the next."""

SPANS = (1e-4, 600.0)
"""Least and greatest width of a window (s)."""


LONGEST = 10_000
"""Characters of what a browser asks for, at most."""

LATEST = 1e9
"""Loop time (s) that is asked for, at most."""


def view_of(text: str) -> View | None:
    """What a browser asks for; None where it asks for nothing sensible."""
    try:
        asked = json.loads(text if len(text) <= LONGEST else "")
        span, end = number(asked["span"]), asked["end"]
        source, axis = str(asked.get("source", "")), str(asked.get("axis", ""))
        spectrum = str(asked.get("spectrum", SPECTRA[0]))
        path = tuple(str(each) for each in asked.get("path", ())[:SIDES])
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
        return None
    if spectrum not in SPECTRA or span is None or not SPANS[0] <= span <= SPANS[1]:
        return None
    if end is not None:
        end = number(end)
        if end is None or abs(end) > LATEST:
            return None
    return View(span, end, source, axis, path, spectrum)


class BrowserFrames:
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
        self._sent, self._word = time.monotonic(), ""

    def next(self) -> bytes | None:
        """The next frame; None where it would be the same again.

        A browser that gets nothing for long knows that it sees what is old.
        """
        now = time.monotonic()
        try:
            frame = self._frame()
        except Exception as error:  # of a recording that is none, or of values that nobody can show
            word = plain(f"this cannot be shown: {error or type(error).__name__}")
            self._last = None
            if word == self._word and now - self._sent < BEAT:
                return None
            self._word = word
            frame = pack({"run": self.desk.trace.run, "span": self.view.span, "word": word}, {})
        if frame is None and now - self._sent >= BEAT:
            frame = pack({"beat": self.desk.silent}, {})
        if frame is not None:
            self._sent = now
        return frame

    def _frame(self) -> bytes | None:
        desk, view = self.desk, self.view
        source: Any = desk.trace
        path: Any = desk.link.path
        limits, axes, axis = desk.limits, desk.link.axes, desk.link.looked_at
        permitted = desk.permitted
        if view.source:
            source = path = desk.recordings.open(view.source, view.axis)
            limits, axes, axis = source.limits, source.axes, source.axis
            permitted = source.permitted
        head: dict[str, Any] = {"limits": limits, "run": desk.trace.run}
        key = (view, source.end, source.first, head["run"])
        if key == self._last:
            return None
        found = look(source, view, desk.period)
        arrays = found.pop("arrays")
        if path is not None and (sides := chosen(axes, view)):
            head |= {"axes": axes, "axis": axis, "path": sides, "permitted": permitted}
            arrays |= along(source, path, view, sides)
        if self._last is None or self._last[0] != view or self._count % SPECTRUM_EVERY == 0:
            arrays |= over_frequency(source, view)
        self._last = key
        self._count += 1
        return pack({**head, **found}, arrays)


async def live(socket: WebSocket, desk: Desk) -> None:
    """Serve a browser until it leaves."""
    await socket.accept()
    frames = BrowserFrames(desk)

    async def listen() -> None:
        while True:
            message = await socket.receive()
            if message["type"] == "websocket.disconnect":
                return
            view = view_of(message.get("text") or "")
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


async def _now(make: Callable[[], Any]) -> Any:
    return make()
