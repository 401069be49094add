r"""PI General Command Set 2.0 as bytes: lines of code page 1252 that end in ``\n``.

A command has no answer. An answer is one line, or several, where every line but the last ends in
a space before its ``\n``. Values look like ``1=3.141``: item, equals sign, number.
"""

from __future__ import annotations

import math

from pea_plant.drivers.driver import DriverError

CODEC = "cp1252"
ASCII = "ascii"
"""The part of it that Python decodes ten times as fast."""

LINE_MAX = 1024
"""Characters of a line, more is no answer to anything that is asked here."""

LINES_MAX = 64
"""Lines of an answer."""

ERRORS = {
    1: "parameter syntax error",
    2: "unknown command",
    5: "motion while the axis has no reference or its servo is off",
    7: "position out of limits",
    10: "stopped by command",
    17: "parameter out of range",
    23: "illegal axis",
    79: "open-loop command while the servo is on",
}


class ProtocolError(DriverError):
    """What came is no answer of this protocol."""


class AnswerReader:
    """Puts answers together from bytes, in whatever pieces they come."""

    def __init__(self) -> None:
        self.rest = b""
        self.lines: list[str] = []

    @property
    def begun(self) -> bool:
        """Whether an answer has begun that is not whole."""
        return bool(self.rest or self.lines)

    def reset(self) -> None:
        """Forget what has begun."""
        self.rest, self.lines = b"", []

    def feed(self, data: bytes) -> list[list[str]]:
        """Take in bytes; the answers that are whole now, each its lines.

        Raises
        ------
        ProtocolError
            Not text, or longer than any answer. What has begun is forgotten.
        """
        *whole, self.rest = (self.rest + data).split(b"\n")
        answers = []
        try:
            for raw in whole:
                self.lines.append(_text(raw))
                if len(self.lines) > LINES_MAX:
                    raise ProtocolError(f"answer of more than {LINES_MAX} lines: is this GCS 2.0?")
                if not raw.endswith(b" "):
                    answers.append(self.lines)
                    self.lines = []
            if len(self.rest) > LINE_MAX:
                _text(self.rest)
        except ProtocolError:
            self.reset()
            raise
        return answers


def _text(raw: bytes) -> str:
    if len(raw) > LINE_MAX:
        raise ProtocolError(f"line of more than {LINE_MAX} characters: is this GCS 2.0?")
    try:
        text = raw.decode(ASCII if raw.isascii() else CODEC)
    except UnicodeDecodeError:
        text = "\0"
    if not text.isprintable():
        raise ProtocolError(f"answer {raw[:20]!r}: is no text; check baud rate and cable")
    return text.removesuffix(" ")


def encode(*lines: str) -> bytes:
    """Commands and questions for one write."""
    text = "".join(f"{line}\n" for line in lines)
    return text.encode(ASCII if text.isascii() else CODEC)


def value(lines: list[str], item: str) -> float:
    """The number that an answer gives for an item.

    Raises
    ------
    ProtocolError
        It does not, or it is no finite number.
    """
    for line in lines:
        name, equals, text = line.partition("=")
        if equals and name.strip() == item:
            return number(text)
    raise ProtocolError(f"answer {_shown(lines)}: lacks a value for {item!r}")


def number(text: str) -> float:
    """A finite number.

    Raises
    ------
    ProtocolError
        It is none.
    """
    try:
        found = float(text)
    except ValueError:
        found = math.nan
    if not math.isfinite(found):
        raise ProtocolError(f"answer {_shown([text])}: must be a finite number")
    return found


def error(lines: list[str]) -> int:
    """Code in the answer to ``ERR?``.

    Raises
    ------
    ProtocolError
        It is no whole number.
    """
    try:
        return int(lines[0])
    except (ValueError, IndexError):
        raise ProtocolError(f"answer {_shown(lines)} to ERR?: must be a whole number") from None


def named(code: int) -> str:
    """Code and name of an error."""
    return f"error {code}, {ERRORS.get(code, 'see the manual of the controller')}"


def _shown(lines: list[str]) -> str:
    return repr(" | ".join(lines)[:60])
