"""Events of a scan to and from CDR bytes of ``std_msgs/Int64MultiArray``, without rclpy.

A message holds a table: a row an event, and the columns that the label of its second dimension
names: the stamp (ns), and the fields of `pea_reference.model.scan.EVENT` after the sample number.
"""

from __future__ import annotations

import numpy as np

from pea_wire.convert import ENCAPSULATION, ConversionError, Reader
from pea_wire.events import Writer

COLUMNS = ("stamp_ns", "kind", "frame", "line", "pixel", "direction")
"""Columns of a message."""

ROWS_MAX = 1 << 20
"""Most events of a message."""


def encode(found: np.ndarray, T_ns: int) -> bytes:
    """One message of events.

    Parameters
    ----------
    found : (n,) structured array
        With the sample number as ``k``, and the other `COLUMNS`.
    T_ns : int
        Sample period (ns).
    """
    table = np.empty((len(found), len(COLUMNS)), "<i8")
    table[:, 0] = found["k"] * T_ns
    for i, name in enumerate(COLUMNS[1:], 1):
        table[:, i] = found[name]
    writer = Writer()
    writer.put("I", 4, 2)
    for label, size, stride in (
        ("events", len(table), table.size),
        (",".join(COLUMNS), len(COLUMNS), len(COLUMNS)),
    ):
        writer.text(label)
        writer.put("I", 4, size, stride)
    writer.put("I", 4, 0, table.size)
    writer.data += bytes(-len(writer.data) % 8 if table.size else 0)
    return ENCAPSULATION + bytes(writer.data) + table.tobytes()


def decode(data: bytes) -> np.ndarray:
    """Events of a message: (n, `COLUMNS`) array of int64.

    Raises
    ------
    ConversionError
        The bytes are no such message.
    """
    reader = Reader(data, "layout")
    labels = []
    for _ in range(reader.count()):
        labels.append(reader.text())
        reader.take("I", 4, 2)
    reader.u32()
    if labels[1:] != [",".join(COLUMNS)]:
        raise reader.wrong(f"columns {labels[1:]}: must be {', '.join(COLUMNS)}")
    reader.field = "data"
    count = reader.count(ROWS_MAX * len(COLUMNS))
    if count % len(COLUMNS):
        raise ConversionError("data", f"{count} numbers: must be rows of {len(COLUMNS)}")
    values = reader.take("q", 8, count) if count else ()
    return np.array(values, np.int64).reshape(-1, len(COLUMNS))
