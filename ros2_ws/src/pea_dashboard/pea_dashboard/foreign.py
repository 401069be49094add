"""Texts and numbers of others: of nodes, files and people. Whatever they are, they can be shown."""

from __future__ import annotations

import math

LONGEST = 200
"""Characters of a text that are shown."""

DIGITS = 18
"""Digits of a count, at most."""

INSTEAD = "\N{REPLACEMENT CHARACTER}"


def plain(text: object, longest: int = LONGEST) -> str:
    """A text of printable characters, not too long: no escape sequence, no half of a character."""
    told = str(text)
    shown = "".join(_character(each) for each in told[:longest])
    return shown if len(told) <= longest else f"{shown}…"


def _character(each: str) -> str:
    if each.isprintable():
        return each
    return " " if each.isspace() else INSTEAD


def count(text: object) -> int | None:
    """A count that somebody has written down; None where it is none."""
    told = str(text)
    return int(told) if told.isascii() and told.isdecimal() and len(told) <= DIGITS else None


def number(value: object) -> float | None:
    """A finite number, or a text that is one; None where it is none."""
    if not isinstance(value, str | int | float) or isinstance(value, bool):
        return None
    try:
        found = float(value)
    except (ValueError, OverflowError):
        return None
    return found if math.isfinite(found) else None
