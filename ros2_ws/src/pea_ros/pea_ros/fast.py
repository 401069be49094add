"""The hop of ``fast``: rclpy takes and publishes, compiled code does what is between."""

from __future__ import annotations

import ctypes
import time
from typing import Any

from pea_engine.cells import Cell, get, put
from pea_engine.kernel import compile_kernel, open_sources
from pea_ros.hop import Hop, answering

WAIT = 0.02
"""Seconds that a message is waited for at a time."""


class FastHop(Hop):
    """Takes and publishes by rclpy."""

    def prepare(self, extra: Any) -> None:
        """Compile, or fetch from disk."""
        answer, sources = answering(self.head, self.lead, self.axes)
        tail, sources = self.tail, sources + open_sources(self.tail)

        def step(known: int, like: object, kept: int, likewise: object, k: int) -> bool:
            sources  # noqa: B018  part of the key under which the result is kept
            T_ns, taken, sent, c, extra = get(known, like)
            s, m = get(kept, likewise)
            fine, s, m = answer(k, T_ns, taken, sent, c, s, m, extra)
            if fine:
                put(kept, (tail(c, s, m), m))
            return fine

        self._known, self._kept = Cell(self._all(extra)), Cell(self.memory)
        self._kernel = compile_kernel(step)
        self._step(-1)

    def _all(self, extra: Any) -> tuple[Any, ...]:
        return self.T_ns, self.taken, self.sent, self.block.c, extra

    def _step(self, k: int) -> bool:
        known, kept = self._known, self._kept
        return bool(self._kernel.again(known.address, known.like, kept.address, kept.like, k))

    def run(self, k: int, end: int, until: int, extra: Any) -> tuple[int, bytes | None]:
        """Serve samples k to `end`, as they come."""
        known, kept, frame = self._known, self._kept, self.sent.bytes
        known.value, kept.value = self._all(extra), self.memory
        wait, take, send = self.inbox.wait, self.inbox.take, self.outbox.send
        step, copy, clock = self._kernel.entry, ctypes.memmove, time.monotonic_ns
        places = known.address, known.like, kept.address, kept.like
        come, size = self.taken.bytes.ctypes.data, self.taken.bytes.size
        data = None
        while k < end:
            wait(WAIT)
            data = take()
            if data is None or len(data) != size:
                break
            copy(come, data, size)
            if not step(*places, k):
                break
            send(frame.tobytes())
            data = None
            k += 1
            if clock() >= until:
                break
        self.memory = kept.value
        return k, None if data is None else self.odd(data)
