"""Work on a device in a thread of its own, so that no other thread waits for it."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Generic, TypeVar

Made = TypeVar("Made")


class GivenUp(Exception):
    """The result of an attempt is no longer wanted."""


class Attempt(Generic[Made]):
    """One attempt, begun at once.

    Parameters
    ----------
    work : callable
        Makes the result. It gets the attempt, and may call its `commit`.
    undo : callable
        Releases a result that is no longer wanted.
    """

    def __init__(self, work: Callable[[Attempt[Made]], Made], undo: Callable[[Made], None]) -> None:
        self._work, self._undo = work, undo
        self._lock = threading.Lock()
        self._committed = self._given_up = self._over = False
        self._made: Made | None = None
        self._error: Exception | None = None
        threading.Thread(target=self._run, name="attempt", daemon=True).start()

    def _run(self) -> None:
        made: Made | None = None
        error: Exception | None = None
        try:
            made = self._work(self)
        except Exception as raised:
            error = raised
        with self._lock:
            self._made, self._error, self._over = made, error, True
            wanted = not self._given_up
        if made is not None and not wanted:
            self._undo(made)

    def commit(self) -> None:
        """Begin the part that must be completed: from now on the attempt cannot be given up.

        Raises
        ------
        GivenUp
            It was given up before.
        """
        with self._lock:
            if self._given_up:
                raise GivenUp
            self._committed = True

    def give_up(self) -> bool:
        """Give it up; return whether that was possible, as it was neither committed nor over."""
        with self._lock:
            self._given_up = not (self._committed or self._over)
            return self._given_up

    @property
    def over(self) -> bool:
        """Whether `result` returns, or raises, without waiting."""
        with self._lock:
            return self._over

    def result(self) -> Made:
        """What was made.

        Raises
        ------
        Exception
            Whatever the work has raised.
        """
        assert self.over
        if self._error is not None:
            raise self._error
        assert self._made is not None
        return self._made
