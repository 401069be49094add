"""Faults of an emulated device.

They are ``NAME[=VALUE][@SECONDS]``: at once, or SECONDS after the next command that reaches the
device. For a fault that was set before the loop starts, this is the loop's first command.

=============== ===================================================================
refuse          new connections are closed at once
drop            all connections are closed, once; a pty for good
mute            silence both ways, as with the cable unplugged
pull            the next answer breaks off in the middle, then mute
truncate        the next answer breaks off in the middle, once
garbage         the next answer is noise, once
delay=S         every answer comes S seconds later
drip=S          every answer comes byte by byte, S seconds apart
babble          every answer is repeated without end
lose=PERCENT    this share of the frames is lost, in both directions (over UDP)
error=CODE      the next command fails with this code, once
stuck           the sensor keeps its value
jump=UM         the sensor reads UM too much (um)
saturate=V      the amplifier gives at most V volts, of either sign
=============== ===================================================================
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from typing import NamedTuple

from pea_core.params import ParameterError, nearest
from pea_core.units import SECOND

FAULTS = {
    "refuse": False,
    "drop": False,
    "mute": False,
    "pull": False,
    "truncate": False,
    "garbage": False,
    "delay": True,
    "drip": True,
    "babble": False,
    "lose": True,
    "error": True,
    "stuck": False,
    "jump": True,
    "saturate": True,
}
"""Faults, and whether they take a value."""


class Fault(NamedTuple):
    """A fault: its name, its value (NaN where it takes none), when it starts.

    That is so long after the next command (s); None: at once.
    """

    name: str
    value: float
    after: float | None


def fault(text: str) -> Fault:
    """Read ``NAME[=VALUE][@SECONDS]``.

    Raises
    ------
    ParameterError
        No such fault, a value missing or too many, no number.
    """
    rest, at, after = text.partition("@")
    name, equals, value = rest.partition("=")
    if name not in FAULTS:
        raise ParameterError(f"fault {text!r}: unknown name {name!r}: {nearest(name, FAULTS)}")
    if bool(equals) != FAULTS[name]:
        form = f"{name}=VALUE" if FAULTS[name] else name
        raise ParameterError(f"fault {text!r}: write {form}[@SECONDS]")
    numbers = []
    for given, number in ((at, after), (equals, value)):
        try:
            numbers.append(float(number) if given else math.nan)
        except ValueError:
            raise ParameterError(f"fault {text!r}: {number!r} is no number") from None
    if (at and not 0.0 <= numbers[0] < math.inf) or (equals and not math.isfinite(numbers[1])):
        raise ParameterError(f"fault {text!r}: SECONDS must be 0 or more, VALUE finite")
    return Fault(name, numbers[1], numbers[0] if at else None)


class Faults:
    """The faults in force, for every thread of an emulator.

    Parameters
    ----------
    clock : callable
        Monotonic clock (ns).
    """

    def __init__(self, clock: Callable[[], int]) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._due: dict[str, tuple[int, float]] = {}
        self._waiting: dict[str, Fault] = {}

    def set(self, which: Fault) -> None:
        """Put a fault in force, now or so long after the next command."""
        with self._lock:
            self._due.pop(which.name, None)
            self._waiting.pop(which.name, None)
            if which.after is None:
                self._due[which.name] = (self._clock(), which.value)
            else:
                self._waiting[which.name] = which

    def commanded(self) -> None:
        """Count from now for what waits for a command."""
        if self._waiting:
            with self._lock:
                for name, which in self._waiting.items():
                    after = round((which.after or 0.0) * SECOND)
                    self._due[name] = (self._clock() + after, which.value)
                self._waiting.clear()

    def clear(self, name: str = "") -> None:
        """End a fault, or all of them."""
        with self._lock:
            for known in (self._due, self._waiting):
                if name:
                    known.pop(name, None)
                else:
                    known.clear()

    def get(self, name: str) -> float | None:
        """Value of a fault in force (NaN where it has none); None where it is not."""
        if not self._due:
            return None
        due = self._due.get(name)
        return due[1] if due is not None and due[0] <= self._clock() else None

    def take(self, name: str) -> float | None:
        """As `get`; the fault has passed then."""
        if not self._due:
            return None
        with self._lock:
            value = self.get(name)
            if value is not None:
                del self._due[name]
            return value
