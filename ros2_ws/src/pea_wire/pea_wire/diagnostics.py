"""Diagnostics as CDR bytes of ``diagnostic_msgs/DiagnosticArray``, without rclpy."""

from __future__ import annotations

from collections.abc import Mapping

from pea_core.units import SECOND
from pea_wire.convert import ENCAPSULATION
from pea_wire.events import Writer

OK, WARN, ERROR = 0, 1, 2
"""Levels."""


def encode(
    stamp: int,
    name: str,
    level: int,
    text: str,
    values: Mapping[str, object],
    space: str = "pea",
    hardware: str = "pea",
) -> bytes:
    """A ``DiagnosticArray`` of one status.

    Parameters
    ----------
    stamp : int
        Loop time (ns).
    name : str
        What it is about; its namespace is put before it.
    level : int
    text : str
    values : mapping
        Keys and values, told as texts.
    space : str
        The namespace, without its slash.
    hardware : str
        Who the hardware is.
    """
    writer = Writer()
    writer.put("i", 4, stamp // SECOND)
    writer.put("I", 4, stamp % SECOND)
    writer.text("")
    writer.put("I", 4, 1)
    writer.put("B", 1, level)
    for words in (f"{space}: {name}", text, hardware):
        writer.text(words)
    writer.put("I", 4, len(values))
    for key, value in values.items():
        writer.text(key)
        writer.text(str(value))
    return ENCAPSULATION + bytes(writer.data)


def transition(
    stamp: int, before: str, after: str, cause: str, space: str = "pea", hardware: str = "pea"
) -> bytes:
    """A change of the safety gate's state."""
    values = {"stamp": stamp, "before": before, "after": after, "cause": cause}
    level, text = of_gate(after), f"{before} -> {after}: {cause}"
    return encode(stamp, "plant: safety", level, text, values, space, hardware)


def of_gate(state: str) -> int:
    """Level of a state of the safety gate."""
    return ERROR if state == "fault" else OK
