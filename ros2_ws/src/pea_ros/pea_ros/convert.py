"""Signals to and from CDR bytes of the standard messages, without rclpy.

A `JointState` of one axis has a fixed layout: it is packed with one `struct` call, and whole
recordings are packed and read as numpy structured arrays. Messages of other publishers may
carry a frame, more axes or other fields; they are read field by field.
"""

from __future__ import annotations

import math
import struct
from typing import NamedTuple

import numpy as np

from pea_ros.topics import AXIS

ENCAPSULATION = b"\x00\x01\x00\x00"
"""CDR, little endian."""


class ConversionError(Exception):
    """A message that does not hold what its topic promises."""


class JointState(NamedTuple):
    """One axis of a ``sensor_msgs/JointState``; NaN where the message leaves a field out.

    Attributes
    ----------
    stamp : int
        Nanoseconds.
    position, velocity, effort : float
        m, m/s, V.
    """

    stamp: int
    position: float
    velocity: float
    effort: float


class Reader:
    """Reads CDR field by field; `ConversionError` where the bytes are none."""

    def __init__(self, data: bytes) -> None:
        if len(data) < 4 or data[0] != 0 or data[1] > 1:
            raise ConversionError("message is not plain CDR")
        self.order = "<" if data[1] else ">"
        self.data = data
        self.at = 4

    def take(self, kind: str, size: int, count: int = 1) -> tuple:
        """Numbers of one kind, as `struct` names it, each of so many bytes."""
        if count:
            self.at += -(self.at - 4) % size
        end = self.at + size * count
        if end > len(self.data):
            raise ConversionError("message ends early")
        values = struct.unpack_from(f"{self.order}{count}{kind}", self.data, self.at)
        self.at = end
        return values

    def u32(self) -> int:
        """A whole number, a count for example."""
        return int(self.take("I", 4)[0])

    def stamp(self) -> int:
        """A time (ns)."""
        return int(self.take("i", 4)[0]) * 10**9 + self.u32()

    def text(self) -> str:
        """A string."""
        size = self.u32()
        letters = bytes(self.take("s", 1, size)[0] if size else b"").rstrip(b"\0")
        try:
            return letters.decode("utf-8")
        except UnicodeDecodeError:
            raise ConversionError(f"a text of {size} bytes is no UTF-8") from None

    def doubles(self) -> tuple:
        """A sequence of float64."""
        count = self.u32()
        return self.take("d", 8, count) if count else ()

    def names(self) -> list[str]:
        """A sequence of strings."""
        return [self.text() for _ in range(self.u32())]


def _axis(names: list[str], axis: str) -> int:
    if axis not in names:
        raise ConversionError(f"no axis {axis!r} among {names}")
    return names.index(axis)


class JointStateCodec:
    """Packs and reads one axis of a ``sensor_msgs/JointState``.

    Parameters
    ----------
    axis : str
        Name of the axis.
    position, velocity, effort : bool
        Which arrays the message carries.
    """

    def __init__(
        self, axis: str, *, position: bool = False, velocity: bool = False, effort: bool = False
    ) -> None:
        self.axis = axis
        self.carries = (position, velocity, effort)
        name = axis.encode() + b"\0"
        body = struct.pack("<I", 1) + b"\0" + b"\0\0\0"  # frame_id ""
        body += struct.pack("<II", 1, len(name)) + name
        body += bytes(-len(body) % 4)
        fields: list[tuple[str, str] | tuple[str, str, int]] = [
            ("encapsulation", "V4"),
            ("sec", "<i4"),
            ("nanosec", "<u4"),
            ("frame_and_name", f"V{len(body)}"),
        ]
        form = "<4siI"
        constant, at = body, 8 + len(body)
        texts: list[bytes] = []
        for field, present in zip(("position", "velocity", "effort"), self.carries):
            fields.append((f"n_{field}", "<u4"))
            constant += struct.pack("<I", present)
            at += 4
            if present:
                pad = -at % 8
                if pad:
                    fields.append((f"pad_{field}", f"V{pad}"))
                fields.append((field, "<f8"))
                constant += bytes(pad)
                form += f"{len(constant)}sd"
                texts.append(constant)
                constant = b""
                at += pad + 8
        form += f"{len(constant)}s"
        texts.append(constant)
        self.dtype = np.dtype(fields)
        self._struct = struct.Struct(form)
        self._body = body
        self._texts = tuple(texts)
        self._blank = [part for text in texts for part in (text, 0.0)][:-1]
        self._places = tuple(sum(self.carries[:i]) if c else -1 for i, c in enumerate(self.carries))
        self.size = self._struct.size
        assert self.size == self.dtype.itemsize
        self._pack = self._struct.pack
        self._unpack = self._struct.unpack

    def encode(self, stamp: int, *values: float) -> bytes:
        """One message at `stamp` (ns); `values` are the fields carried, in order."""
        parts = [ENCAPSULATION, *divmod(stamp, 1_000_000_000), *self._blank]
        parts[4::2] = values
        return self._pack(*parts)

    def decode(self, data: bytes) -> JointState:
        """Read one message.

        Raises
        ------
        ConversionError
            The axis is missing, or the bytes are no such message.
        """
        if len(data) == self.size:
            head, sec, nanosec, *parts = self._unpack(data)
            if head == ENCAPSULATION and tuple(parts[::2]) == self._texts:
                values = (*parts[1::2], math.nan)
                a, b, c = self._places
                return JointState(sec * 1_000_000_000 + nanosec, values[a], values[b], values[c])
        return self._decode_any(data)

    def _decode_any(self, data: bytes) -> JointState:
        reader = Reader(data)
        stamp = reader.stamp()
        reader.text()
        i = _axis(reader.names(), self.axis)
        fields = [reader.doubles() for _ in range(3)]
        return JointState(stamp, *(f[i] if len(f) > i else math.nan for f in fields))

    def encode_many(self, stamps: np.ndarray, *values: np.ndarray) -> np.ndarray:
        """Messages as a structured array whose bytes are the CDR of one message a row.

        Parameters
        ----------
        stamps : (n,) array of int64
            Nanoseconds.
        *values : (n,) arrays
            The fields carried, in order.
        """
        rows = np.zeros(len(stamps), self.dtype)
        rows["encapsulation"] = np.frombuffer(ENCAPSULATION, "V4")[0]
        rows["sec"], rows["nanosec"] = np.divmod(stamps, 1_000_000_000)
        rows["frame_and_name"] = np.frombuffer(self._body, f"V{len(self._body)}")[0]
        rest = iter(values)
        for field, present in zip(("position", "velocity", "effort"), self.carries):
            if present:
                rows[f"n_{field}"] = 1
                rows[field] = next(rest)
        return rows


_POINT = [
    ("n_positions", "<u4"),
    ("pad_positions", "V4"),
    ("position", "<f8"),
    ("n_velocities", "<u4"),
    ("pad_velocities", "V4"),
    ("velocity", "<f8"),
    ("n_accelerations", "<u4"),
    ("pad_accelerations", "V4"),
    ("acceleration", "<f8"),
    ("n_effort", "<u4"),
    ("sec", "<i4"),
    ("nanosec", "<u4"),
]
_POINT_MIN = 24
"""Bytes of a trajectory point without a number in it."""

_ALIGNED = np.dtype(_POINT)
_SHIFTED = np.dtype([field for field in _POINT if field[0] != "pad_positions"])
"""A trajectory point that starts at a multiple of 8, and 4 bytes behind one."""


class TrajectoryCodec:
    """Packs and reads one axis of a ``trajectory_msgs/JointTrajectory`` chunk.

    Parameters
    ----------
    axis : str
        Name of the axis.
    """

    def __init__(self, axis: str) -> None:
        self.axis = axis
        name = axis.encode() + b"\0"
        body = struct.pack("<I", 1) + b"\0" + b"\0\0\0"
        body += struct.pack("<II", 1, len(name)) + name
        self._body = body + bytes(-len(body) % 4)

    def encode(self, stamp: int, period: int, points: np.ndarray) -> bytes:
        """One chunk.

        Parameters
        ----------
        stamp, period : int
            Time of the first point and distance of the points (ns).
        points : (n, 3) array
            w (m), w_dot (m/s), w_ddot (m/s^2).
        """
        sec, nanosec = divmod(stamp, 1_000_000_000)
        head = struct.pack("<iI", sec, nanosec) + self._body + struct.pack("<I", len(points))
        times = np.arange(len(points), dtype=np.int64) * period
        if len(head) % 8 == 0:
            first = self._points(_ALIGNED, times[:1], points[:1])
            rest = self._points(_SHIFTED, times[1:], points[1:])
            return ENCAPSULATION + head + first + rest
        return ENCAPSULATION + head + self._points(_SHIFTED, times, points)

    def _each(self) -> np.dtype:
        """Layout of a message of one point."""
        point = _SHIFTED if (12 + len(self._body)) % 8 else _ALIGNED
        return np.dtype(
            [
                ("encapsulation", "V4"),
                ("sec", "<i4"),
                ("nanosec", "<u4"),
                ("head", f"V{len(self._body) + 4}"),
                ("point", point),
            ]
        )

    def encode_each(self, stamps: np.ndarray, *values: np.ndarray) -> np.ndarray:
        """Messages of one point each, as a structured array whose bytes are the CDR of one a row.

        Parameters
        ----------
        stamps : (n,) array of int64
            Nanoseconds.
        *values : (n,) arrays
            w (m), w_dot (m/s), w_ddot (m/s^2).
        """
        one = self.encode(0, 0, np.zeros((1, 3)))
        rows = np.frombuffer(bytearray(one * len(stamps)), self._each())
        rows["sec"], rows["nanosec"] = np.divmod(stamps, 1_000_000_000)
        for field, value in zip(("position", "velocity", "acceleration"), values, strict=True):
            rows["point"][field] = value
        return rows

    def decode_each(self, payload: bytes) -> np.ndarray:
        """w (m) of messages from `encode_each`, one behind the other: (n,) array.

        Raises
        ------
        ConversionError
            They are no such messages.
        """
        layout = self._each()
        if len(payload) % layout.itemsize:
            raise ConversionError("no messages of one point each")
        w: np.ndarray = np.frombuffer(payload, layout)["point"]["position"]
        return w

    @staticmethod
    def _points(dtype: np.dtype, times: np.ndarray, points: np.ndarray) -> bytes:
        rows = np.zeros(len(points), dtype)
        for i, field in enumerate(("position", "velocity", "acceleration")):
            rows[field] = points[:, i]
        for count in ("n_positions", "n_velocities", "n_accelerations"):
            rows[count] = 1
        rows["sec"], rows["nanosec"] = np.divmod(times, 1_000_000_000)
        return rows.tobytes()

    def decode(self, data: bytes) -> tuple[int, np.ndarray, np.ndarray]:
        """Read one chunk.

        Returns
        -------
        int
            Stamp of the message (ns).
        (n,) array of int64
            Time of each point after the stamp (ns).
        (n, 3) array
            w (m), w_dot (m/s), w_ddot (m/s^2).

        Raises
        ------
        ConversionError
            The axis is missing, a point lacks a derivative, or the bytes are no such message.
        """
        reader = Reader(data)
        stamp = reader.stamp()
        reader.text()
        i = _axis(reader.names(), self.axis)
        n = reader.u32()
        if n * _POINT_MIN > len(data) - reader.at:
            raise ConversionError("message ends early")
        plain = reader.order == "<" and i == 0
        fast = self._decode_fixed(data, reader.at, n) if plain else None
        if fast is not None:
            return stamp, *fast
        times = np.empty(n, np.int64)
        points = np.empty((n, 3))
        for row in range(n):
            fields = [reader.doubles() for _ in range(3)]
            reader.doubles()
            if any(len(f) <= i for f in fields):
                raise ConversionError(f"point {row} lacks position, velocity or acceleration")
            points[row] = [f[i] for f in fields]
            times[row] = reader.stamp()
        return stamp, times, points

    @staticmethod
    def _decode_fixed(data: bytes, at: int, n: int) -> tuple[np.ndarray, np.ndarray] | None:
        if n == 0:
            return np.empty(0, np.int64), np.empty((0, 3))
        first = _ALIGNED if (at - 4) % 8 == 0 else _SHIFTED
        if at + first.itemsize + (n - 1) * _SHIFTED.itemsize > len(data):
            return None
        parts = [
            np.frombuffer(data, first, 1, at),
            np.frombuffer(data, _SHIFTED, n - 1, at + first.itemsize),
        ]
        counts = ("n_positions", "n_velocities", "n_accelerations")
        if any((p[c] != 1).any() for p in parts for c in counts) or any(
            p["n_effort"].any() for p in parts
        ):
            return None

        def column(field: str) -> np.ndarray:
            return np.concatenate([p[field] for p in parts])

        times = column("sec").astype(np.int64) * 1_000_000_000 + column("nanosec")
        return times, np.stack([column(f) for f in ("position", "velocity", "acceleration")], 1)


STATE = JointStateCodec(AXIS, position=True, velocity=True, effort=True)
"""Codec of `topics.STATE`: x̂1 (m), x̂2 (m/s), eps (V)."""

VOLTAGE = JointStateCodec(AXIS, effort=True)
"""Codec of `topics.VOLTAGE`: u (V)."""

DISPLACEMENT = JointStateCodec(AXIS, position=True, effort=True)
"""Codec of `topics.DISPLACEMENT`: y (m), voltage applied (V)."""

DISPLACEMENT_IDEAL = JointStateCodec(AXIS, position=True, velocity=True, effort=True)
"""The same with the true velocity (m/s) of an ideal sensor."""


def decode_displacement(data: bytes) -> JointState:
    """Read `topics.DISPLACEMENT`, of an ideal sensor or another.

    Raises
    ------
    ConversionError
        The axis is missing, or the bytes are no such message.
    """
    ideal = len(data) == DISPLACEMENT_IDEAL.size
    return (DISPLACEMENT_IDEAL if ideal else DISPLACEMENT).decode(data)


REFERENCE = TrajectoryCodec(AXIS)
"""Codec of `topics.REFERENCE`: w (m), w_dot (m/s), w_ddot (m/s^2)."""

_TIME = struct.Struct("<4siI")


def stamp(data: bytes) -> int:
    """Stamp (ns) of a message that begins with a header or a time.

    Raises
    ------
    ConversionError
        It is too short, or no CDR.
    """
    if len(data) >= _TIME.size and data[:4] == ENCAPSULATION:
        _, sec, nanosec = _TIME.unpack_from(data)
        return int(sec * 1_000_000_000 + nanosec)
    return Reader(data).stamp()


def stamps(payload: bytes, size: int) -> np.ndarray:
    """Stamps (ns) of messages of `size` bytes that begin with a header: (n,) array of int64."""
    rows = np.frombuffer(payload, np.uint8).reshape(-1, size)
    sec, nanosec = rows[:, 4:8].copy().view("<i4"), rows[:, 8:12].copy().view("<u4")
    return sec[:, 0].astype(np.int64) * 1_000_000_000 + nanosec[:, 0]


def encode_time(stamp: int) -> bytes:
    """``builtin_interfaces/Time`` of `stamp` (ns)."""
    return _TIME.pack(ENCAPSULATION, *divmod(stamp, 1_000_000_000))


def decode_time(data: bytes) -> int:
    """Stamp (ns) of a ``builtin_interfaces/Time``."""
    return Reader(data).stamp()


_DIM = struct.Struct("<I8s2I")
_BLOCK = struct.Struct(f"<4sI{_DIM.size}s{_DIM.size}sII")


def encode_block(size: int, payload: bytes) -> bytes:
    """``std_msgs/UInt8MultiArray`` of messages of `size` bytes each, one behind the other."""
    count = len(payload) // size
    rows = _DIM.pack(5, b"rows\0", count, len(payload))
    row = _DIM.pack(5, b"byte\0", size, size)
    return _BLOCK.pack(ENCAPSULATION, 2, rows, row, 0, len(payload)) + payload


def decode_block(data: bytes) -> tuple[int, bytes]:
    """Size of each message of a block, and the messages one behind the other.

    Raises
    ------
    ConversionError
        The bytes are no such block.
    """
    reader = Reader(data)
    sizes = []
    for _ in range(reader.u32()):
        reader.text()
        sizes.append((reader.u32(), reader.u32()))
    reader.u32()
    count = reader.u32()
    payload = bytes(reader.take("s", 1, count)[0]) if count else b""
    if len(sizes) != 2 or sizes[0][0] * sizes[1][0] != count or not count:
        raise ConversionError("no block of messages of equal size")
    return sizes[1][0], payload


def find(block: bytes, stamp: int) -> bytes | None:
    """The message of a block that has a stamp (ns), or None.

    Raises
    ------
    ConversionError
        The bytes are no such block.
    """
    size, payload = decode_block(block)
    found = np.flatnonzero(stamps(payload, size) == stamp)
    return payload[found[0] * size : (found[0] + 1) * size] if len(found) else None
