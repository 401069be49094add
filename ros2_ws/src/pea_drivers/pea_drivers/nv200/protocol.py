r"""What an NV200/D says on the wire: lines of text in frames; no I/O.

A command is ``NAME`` to read, ``NAME,VALUE`` to set, and ends in ``\r\n``. The device stops the
line with XOFF, answers ``NAME,VALUE,...\r\n`` to a reading, ``error,CODE\r\n`` to what it refuses,
nothing to a setting, and opens the line again with XON: a frame ends in XON. An empty command
asks for the name of the device. Over Telnet all of it is the same, with options of the Telnet
protocol between.
"""

from __future__ import annotations

import math
import re
from typing import NamedTuple

from pea_plant.drivers.driver import DriverError

XON, XOFF = 0x11, 0x13
END = b"\r\n"
PADDING = b"\0\1\r\n"
"""Bytes around the text of a frame, and between frames."""

LONGEST = 256
"""Bytes of a frame at most; the longest that is asked for has some thirty."""

ERRORS = {
    1: "not specified",
    2: "unknown command",
    3: "parameter missing",
    4: "admissible parameter range exceeded",
    5: "too many parameters",
    6: "parameter locked or read only",
    7: "underload",
    8: "overload",
    9: "parameter too low",
    10: "parameter too high",
}
"""Names of the error codes."""

CONNECTED, SENSOR, CLOSED_LOOP = 1 << 0, 3 << 1, 1 << 3
"""Bits of ``stat``: actuator connected, kind of its sensor (0: none), loop closed."""

FAILURES = {
    1 << 10: "temperature too high",
    1 << 11: "actuator error",
    1 << 12: "hardware error",
    1 << 13: "I2C error",
}
"""Bits of ``stat`` that stand for a failure, and their names."""

IAC, DONT, DO, WONT, WILL, SB, SE = 255, 254, 253, 252, 251, 250, 240
"""Bytes of the Telnet protocol."""

_NUMBER = re.compile(r"[+-]?[0-9]{1,12}(\.[0-9]{0,12})?([eE][+-]?[0-9]{1,2})?")


class ProtocolError(DriverError):
    """What came is nothing that an NV200 sends."""


class Reply(NamedTuple):
    """A frame: name and values; both empty where a setting was taken."""

    name: str
    values: tuple[str, ...]

    def __str__(self) -> str:
        return ",".join((self.name, *self.values))


def command(name: str, *values: float) -> bytes:
    """A command line; values with the three decimals that the device itself shows."""
    texts = [name, *(f"{round(value, 3) + 0.0:.3f}" for value in values)]
    return ",".join(texts).encode("ascii") + END


def error(reply: Reply) -> str | None:
    """What a reply refuses, as ``error CODE (name)``; None where it does not.

    Raises
    ------
    ProtocolError
        An error without a code.
    """
    if reply.name != "error":
        return None
    code = number(reply)
    return f"error {code:g} ({ERRORS.get(int(code), 'unknown')})"


def is_number(text: str) -> bool:
    """Whether a text is a number as the device writes it, and takes it."""
    return _NUMBER.fullmatch(text.strip()) is not None


def number(reply: Reply) -> float:
    """The one finite number of a reply.

    Raises
    ------
    ProtocolError
        None, or several.
    """
    if len(reply.values) != 1 or not is_number(reply.values[0]):
        raise ProtocolError(f"answer {str(reply)[:40]!r}: must be a name and one number")
    value = float(reply.values[0])
    if not math.isfinite(value):
        raise ProtocolError(f"answer {str(reply)[:40]!r}: must be finite")
    return value


def identity(reply: Reply) -> str:
    """Name of a device, from its reply to an empty command."""
    return str(reply).strip("<> ")


def framed(reply: Reply) -> re.Pattern[bytes]:
    """What finds the frame of a reply in a stream of bytes."""
    return re.compile(re.escape(str(reply).encode("latin-1")) + rb"[\0\1\r\n]*\x11")


class Replies:
    """Frames out of a stream of bytes, in any pieces."""

    def __init__(self) -> None:
        self.frame = bytearray()

    @property
    def begun(self) -> bool:
        """Whether a frame has begun that is not whole."""
        return bool(self.frame.strip(PADDING))

    def feed(self, data: bytes) -> list[Reply]:
        """Take in what came; the replies that are whole now.

        Raises
        ------
        ProtocolError
            No frame of an NV200; what came of it is forgotten.
        """
        self.frame += data
        *frames, rest = self.frame.split(bytes([XON]))
        self.frame = bytearray(rest)
        try:
            if len(rest) > LONGEST:
                raise ProtocolError(f"{len(rest)} bytes and no end of a frame")
            return [reply for frame in frames for reply in _replies(bytes(frame))]
        except ProtocolError:
            self.frame.clear()
            raise


def _replies(frame: bytes) -> list[Reply]:
    """Replies of a frame: one, or one for each of several commands sent at once."""
    if len(frame) > LONGEST:
        raise ProtocolError(f"a frame of {len(frame)} bytes")
    text = frame.decode("latin-1").translate({XOFF: None}).strip(PADDING.decode())
    if not text:
        return [Reply("", ())]
    replies = []
    for line in re.split("[\r\n]+", text):
        if not line.isprintable():
            raise ProtocolError(f"answer {line[:40]!r}: must be text")
        name, *values = line.split(",")
        replies.append(Reply(name, tuple(values)))
    return replies


class Telnet:
    """Options of the Telnet protocol, taken out of a stream of bytes and declined."""

    def __init__(self) -> None:
        self._state = 0

    def feed(self, data: bytes) -> tuple[bytes, bytes]:
        """Take in what came; what is left of it without options, and what to send in return."""
        if not self._state and IAC not in data:
            return data, b""
        left, answers = bytearray(), bytearray()
        for byte in data:
            self._state = self._step(self._state, byte, left, answers)
        return bytes(left), bytes(answers)

    def _step(self, state: int, byte: int, left: bytearray, answers: bytearray) -> int:
        """Take one byte; the state after it: 0, or what a byte of an option waits for."""
        if state == 0 and byte != IAC:
            left.append(byte)
        elif state == 0:
            return IAC
        elif state == IAC:
            if byte == IAC:
                left.append(IAC)
            return byte if byte in (DO, DONT, WILL, WONT, SB) else 0
        elif state in (DO, WILL):
            answers += bytes([IAC, WONT if state == DO else DONT, byte])
        elif state == SB:
            return SE if byte == IAC else SB
        elif state == SE and byte != SE:
            return SB
        return 0


class Commands:
    """Command lines out of a stream of bytes, as the device sees them."""

    def __init__(self) -> None:
        self.line = bytearray()
        self._after_cr = False

    def feed(self, data: bytes) -> list[tuple[str, ...]]:
        """Take in what came; name and values of each command that is whole now."""
        lines = []
        for byte in data:
            if byte == 0x0A and self._after_cr:
                self._after_cr = False
                continue
            self._after_cr = byte == 0x0D
            if byte in END:
                lines.append(tuple(self.line.decode("latin-1").strip().split(",")))
                self.line.clear()
            elif byte not in (XON, XOFF, 0) and len(self.line) < LONGEST:
                self.line.append(byte)
        return lines
