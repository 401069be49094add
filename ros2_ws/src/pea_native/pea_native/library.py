"""A driver as a shared library: loaded, called through ctypes, checked before it is trusted.

Imports nothing but the standard library: the watchdog runs this file as well, where Python has no
other path, and so does the check, in a process of its own that a bad library may crash or hang.
``python library.py check JSON`` prints what 1000 exchanges with the output held have shown.
"""

from __future__ import annotations

import ctypes
import json
import math
import os
import struct
import sys
import time
from collections.abc import Callable
from typing import Any, NamedTuple

VERSION = 1
"""`PEA_DRIVER_VERSION` that is asked for."""

DRIVE, RESCUE = range(2)
CLOCK, DEVICE = "clock", "device"
PACES = (CLOCK, DEVICE)
"""Who sets the pace, in the order of the header's numbers."""

HOLD, FRESH = 1, 2
"""Flags of an exchange: it commands nothing; it forgets the samples that wait."""

CODES = {
    1: "no answer within timeout_s",
    2: "an answer that makes no sense",
    3: "the device refuses the command",
    4: "the device is gone",
}
"""What the numbers mean that an exchange returns."""

SYMBOLS = ("version", "open", "identify", "limits", "exchange", "safe", "close")
DRY = 1000
"""Exchanges with the output held before anything is commanded."""

SIZE = 256
HELD = 1e-6
"""Share of the device's range by which the output may seem to move while it is held."""


class Refused(Exception):
    """A library or its device cannot be used; one line."""


class Options(ctypes.Structure):
    """``pea_options`` of the header."""

    _fields_ = (
        ("address", ctypes.c_char_p),
        ("period_ns", ctypes.c_int64),
        ("timeout_ns", ctypes.c_int64),
        ("connect_ns", ctypes.c_int64),
        ("role", ctypes.c_uint32),
        ("pace", ctypes.c_uint32),
    )


class NativeLimits(ctypes.Structure):
    """``pea_limits`` of the header."""

    _fields_ = tuple(
        (name, ctypes.c_double) for name in ("voltage_min", "voltage_max", "y_min", "y_max")
    )


class Sample(ctypes.Structure):
    """``pea_sample`` of the header."""

    _fields_ = (
        ("y", ctypes.c_double),
        ("u_applied", ctypes.c_double),
        ("counter", ctypes.c_uint64),
    )


class Line(NamedTuple):
    """Which library, which device, how long it may take (s): what is handed to other processes."""

    library: str
    address: str
    period_ns: int
    timeout_s: float
    connect_s: float
    pace: str


def code_of(number: int) -> str:
    """What an exchange has returned, in words."""
    return CODES.get(number, f"the library's own error {number}")


class Library:
    """A library, and the device that it has open.

    Parameters
    ----------
    line : Line
    role : int
        `DRIVE` or `RESCUE`.

    Attributes
    ----------
    functions : dict
        By their names without ``pea_driver_``.
    device : int
        Address of the library's own ``pea_device``.

    Raises
    ------
    Refused
        It cannot be loaded, lacks a function, is of another version, or opens no device.
    """

    def __init__(self, line: Line, role: int = DRIVE) -> None:
        self.line = line
        self.device = 0
        try:
            self._loaded = ctypes.CDLL(line.library)
        except OSError as error:
            raise Refused(f"cannot be loaded: {error}") from None
        self.functions: dict[str, Any] = {}
        for name in SYMBOLS:
            try:
                self.functions[name] = getattr(self._loaded, f"pea_driver_{name}")
            except AttributeError:
                raise Refused(f"has no function pea_driver_{name}; see pea_driver.h") from None
        self._declare()
        if (found := self.functions["version"]()) != VERSION:
            raise Refused(
                f"is of version {found} of pea_driver.h, version {VERSION} is needed; compile it "
                "again"
            )
        self._text = ctypes.create_string_buffer(SIZE)
        self._options = Options(
            line.address.encode(),
            line.period_ns,
            round(line.timeout_s * 1e9),
            round(line.connect_s * 1e9),
            role,
            PACES.index(line.pace),
        )
        self.device = self.functions["open"](ctypes.byref(self._options), self._text, SIZE) or 0
        if not self.device:
            raise Refused(_line(self._text.value) or "opens no device, and does not say why")

    def _declare(self) -> None:
        device, number = ctypes.c_void_p, ctypes.c_int
        pointer = ctypes.POINTER
        for name, result, arguments in (
            ("version", ctypes.c_uint32, ()),
            ("open", device, (pointer(Options), ctypes.c_char_p, ctypes.c_size_t)),
            ("identify", number, (device, ctypes.c_char_p, ctypes.c_size_t)),
            ("limits", number, (device, pointer(NativeLimits))),
            ("exchange", number, (device, ctypes.c_double, ctypes.c_uint32, pointer(Sample))),
            ("safe", number, (device, ctypes.c_double)),
            ("close", None, (device,)),
        ):
            self.functions[name].restype = result
            self.functions[name].argtypes = arguments

    def identity(self) -> str:
        """Who answered, in its own words."""
        code = self.functions["identify"](self.device, self._text, SIZE)
        if code:
            raise Refused(f"pea_driver_identify: {code_of(code)}")
        return _line(self._text.value)

    def limits(self) -> tuple[float, float, float, float]:
        """Range of the voltage (V) and of the displacement (m)."""
        found = NativeLimits()
        if code := self.functions["limits"](self.device, ctypes.byref(found)):
            raise Refused(f"pea_driver_limits: {code_of(code)}")
        low, high, y_min, y_max = found.voltage_min, found.voltage_max, found.y_min, found.y_max
        for name, a, b in (("voltage", low, high), ("y", y_min, y_max)):
            if not (math.isfinite(a) and math.isfinite(b) and a < b):
                raise Refused(
                    f"pea_driver_limits: {name}_min = {a:g} must be below {name}_max = {b:g}"
                )
        return low, high, y_min, y_max

    def exchange(self, u: float, flags: int = 0) -> Sample:
        """Command u (V), or nothing with `HOLD`; the sample."""
        sample = Sample(math.nan, math.nan, 0)
        if code := self.functions["exchange"](self.device, u, flags, ctypes.byref(sample)):
            raise Refused(code_of(code))
        return sample

    def safe(self, u: float) -> None:
        """Command u (V) whatever was sent before."""
        if code := self.functions["safe"](self.device, u):
            raise OSError(code_of(code))

    def close(self) -> None:
        """Close the device; it holds its voltage."""
        if self.device:
            self.functions["close"](self.device)
            self.device = 0


def _line(text: bytes) -> str:
    words = " ".join(text.decode(errors="replace").split())
    return "".join(c if c.isprintable() else "?" for c in words)


def held(sample: Sample, low: float, high: float) -> float:
    """Voltage (V) of a sample, if a device between two could hold it.

    Raises
    ------
    Refused
        It could not.
    """
    slack = 1e-6 * (high - low)
    u: float = sample.u_applied
    if not low - slack <= u <= high + slack:
        raise Refused(f"u_applied = {u:g} V: the device's range is {low:g} to {high:g} V")
    return u


class Tried(NamedTuple):
    """What the check has found: times of an exchange (us), samples that the device has counted."""

    identity: str
    limits: tuple[float, float, float, float]
    exchange_us: tuple[float, ...]
    counted: int


def check(line: Line, exchanges: int = DRY) -> Tried:
    """Open a device, look at it, make exchanges with the output held, close it.

    Raises
    ------
    Refused
        Whatever does not keep the rules of the header.
    """
    library = Library(line)
    try:
        identity, limits = library.identity(), library.limits()
        took, first, last, before = [], 0, 0, math.nan
        for i in range(exchanges):
            began = time.monotonic_ns()
            sample = library.exchange(math.nan, HOLD if i else HOLD | FRESH)
            took.append((time.monotonic_ns() - began) * 1e-3)
            u = held(sample, *limits[:2])
            if i and abs(u - before) > HELD * (limits[1] - limits[0]):
                raise Refused(f"the output moves from {before:g} to {u:g} V while it is held")
            if not math.isfinite(sample.y):
                raise Refused(f"y = {sample.y} m at exchange {i}: must be a finite number")
            if i and (sample.counter < last or (line.pace == DEVICE and sample.counter == last)):
                raise Refused(f"counter {sample.counter} after {last}: it must rise")
            first = first if i else sample.counter
            last, before = sample.counter, u
        slow = sum(t > line.timeout_s * 1e6 for t in took)
        if slow > exchanges // 100:
            longest = max(took) * 1e-6
            raise Refused(f"an exchange took {longest:.2g} s, timeout_s is {line.timeout_s:g} s")
        return Tried(identity, limits, tuple(took), last - first + 1)
    except Refused as error:
        raise Refused(f"{line.address}: {error}") from None
    finally:
        library.close()


def opened(text: str) -> Callable[[bytes], None]:
    """For the watchdog: open a device beside the loop; what sends it a command of 8 bytes."""
    library = Library(Line(*json.loads(text)), RESCUE)

    def send(data: bytes) -> None:
        if data:
            library.safe(struct.unpack("<d", data)[0])

    return send


def main() -> int:
    """Check a library: the process."""
    line, exchanges = json.loads(sys.argv[1]), int(sys.argv[2])
    out = os.dup(1)  # whatever the library prints goes elsewhere
    os.dup2(2, 1)
    try:
        told: Any = {"tried": check(Line(*line), exchanges)._asdict()}
    except Refused as error:
        told = {"refused": str(error)}
    os.write(out, json.dumps(told).encode() + b"\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
