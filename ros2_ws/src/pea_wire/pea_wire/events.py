"""Parameter changes to and from CDR bytes of ``rcl_interfaces/ParameterEvent``, without rclpy."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from pea_core.params import Value
from pea_core.units import SECOND
from pea_wire.convert import ENCAPSULATION, ConversionError, Reader

_ARRAYS = {5: ("B", 1), 6: ("?", 1), 7: ("q", 8), 8: ("d", 8)}
"""ParameterType of each array of numbers, and how its elements are laid out."""


class ParameterEvent(NamedTuple):
    """What a node said of its parameters.

    Attributes
    ----------
    stamp : int
        Loop time (ns) of the first sample that goes by the new values.
    node : str
        Full name of the node.
    new, changed : dict
        Values by name; None where the message gives none.
    """

    stamp: int
    node: str
    new: dict[str, Value | None]
    changed: dict[str, Value | None]

    @property
    def asked(self) -> dict[str, Value | None]:
        """What was changed, with what another type has; what is new alone was only declared."""
        return {**self.changed, **self.new} if self.changed else {}

    def of(self, axis: str, axes: Sequence[str]) -> ParameterEvent:
        """What it says of one of several axes: ``x.NAME`` of the axis x is its ``NAME``."""
        others = tuple(f"{other}." for other in axes if other != axis)

        def own(values: Mapping[str, Value | None]) -> dict[str, Value | None]:
            return {
                name.removeprefix(f"{axis}."): value
                for name, value in values.items()
                if not name.startswith(others)
            }

        return self._replace(new=own(self.new), changed=own(self.changed))


class Writer:
    """Writes CDR field by field."""

    def __init__(self) -> None:
        self.data = bytearray()

    def put(self, kind: str, size: int, *values: object) -> None:
        """Numbers of one kind, as `struct` names it, each of so many bytes."""
        if values:
            self.data += bytes(-len(self.data) % size)
            self.data += struct.pack(f"<{len(values)}{kind}", *values)

    def text(self, text: str) -> None:
        """A string."""
        letters = text.encode() + b"\0"
        self.put("I", 4, len(letters))
        self.data += letters

    def value(self, value: Value) -> None:
        """A ``ParameterValue``: every field is there, the type says which one counts."""
        many = isinstance(value, tuple)
        elements: tuple[object, ...] = value if isinstance(value, tuple) else (value,)
        kind = {bool: 1, int: 2, float: 3, str: 4}[type(elements[0])]
        self.put("B", 1, kind + 5 if many else kind)
        self.put("?", 1, value if kind == 1 and not many else False)
        self.put("q", 8, value if kind == 2 and not many else 0)
        self.put("d", 8, value if kind == 3 and not many else 0.0)
        self.text(str(value) if kind == 4 and not many else "")
        for array in (5, 6, 7, 8, 9):
            values = elements if many and array == kind + 5 else ()
            self.put("I", 4, len(values))
            if array == 9:
                for text in values:
                    self.text(str(text))
            else:
                self.put(*_ARRAYS[array], *values)


def encode(stamp: int, node: str, changed: Mapping[str, Value]) -> bytes:
    """A ``ParameterEvent`` of values that have changed.

    Parameters
    ----------
    stamp : int
        Loop time (ns) of the first sample that goes by them.
    node : str
        Full name of the node.
    changed : mapping
        Names and values; an array holds at least one.
    """
    writer = Writer()
    writer.put("i", 4, stamp // SECOND)
    writer.put("I", 4, stamp % SECOND)
    writer.text(node)
    writer.put("I", 4, 0)
    writer.put("I", 4, len(changed))
    for name, value in changed.items():
        writer.text(name)
        writer.value(value)
    writer.put("I", 4, 0)
    return ENCAPSULATION + bytes(writer.data)


def decode(data: bytes) -> ParameterEvent:
    """Read a ``ParameterEvent``.

    Raises
    ------
    ConversionError
        The bytes are no such message.
    """
    reader = Reader(data, "stamp")
    stamp = reader.stamp()
    reader.field = "node"
    node = reader.text()
    reader.field = "parameters"
    return ParameterEvent(stamp, node, _parameters(reader), _parameters(reader))


def _parameters(reader: Reader) -> dict[str, Value | None]:
    found = {}
    for _ in range(reader.count()):
        name = reader.text()
        found[name] = _value(reader)
    return found


def _value(reader: Reader) -> Value | None:
    kind = reader.take("B", 1)[0]
    values: list[Any] = [None]
    values += [reader.take(form, size)[0] for form, size in (("?", 1), ("q", 8), ("d", 8))]
    values.append(reader.text())
    for form, size in _ARRAYS.values():
        values.append(reader.take(form, size, reader.u32()))
    values.append(tuple(reader.names()))
    if kind >= len(values):
        raise ConversionError("parameters", f"one is of type {kind}: must be 0 to 9")
    value: Value | None = values[kind]
    return value
