"""Ctrl-C, held off while C code may call Python.

What numba returns becomes Python objects by way of Python code, in which a signal's exception
would end the process with a segmentation fault. rclpy turns messages into Python objects alike;
there it becomes an error that looks like a fault of rclpy's.
"""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator
from types import FrameType

CALLBACKS = frozenset({"_raw_object_cache_notify", "_raw_object_cache_getbuffer"})
"""Functions of llvmlite that LLVM calls: an exception in them is lost, and what is compiled too."""


class Interrupt:
    """Handler of SIGINT and SIGTERM: raises KeyboardInterrupt, at once or when it may."""

    def __init__(self) -> None:
        self._held = False
        self._come = False

    def __call__(self, number: int, frame: FrameType | None) -> None:
        """Take a signal; one that comes while LLVM calls Python waits for the next `held`."""
        self._come = True
        if not self._held and not _in_callback(frame):
            self._raise()

    def _raise(self) -> None:
        self._come = False
        raise KeyboardInterrupt

    @contextlib.contextmanager
    def held(self) -> Iterator[None]:
        """Hold it off; raise at the end what has come meanwhile.

        Signals reach the main thread alone: elsewhere this does nothing. Another handler of
        SIGINT is put aside meanwhile, and called at the end instead.
        """
        if self._held or threading.current_thread() is not threading.main_thread():
            yield
            return
        other = signal.getsignal(signal.SIGINT)
        aside = other if other is not self and callable(other) else None
        if aside:
            signal.signal(signal.SIGINT, self)
        self._held = True
        try:
            yield
        finally:
            self._held = False
            if aside:
                signal.signal(signal.SIGINT, aside)
        if self._come and aside:
            self._come = False
            aside(signal.SIGINT, None)
        elif self._come:
            self._raise()


def _in_callback(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_code.co_name in CALLBACKS:
            return True
        frame = frame.f_back
    return False


INTERRUPT = Interrupt()
"""The one handler of a process."""
