"""Signals to and from CDR bytes of the standard messages, without rclpy.

A `JointState` of known axes has a fixed layout: it is packed with one `struct` call, and whole
recordings are packed and read as numpy structured arrays. Messages of other publishers may
carry a frame, more axes or other fields; they are read field by field. `Forms` has the codecs of
a loop's axes; a value of one axis is a number, of several a tuple in their order.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from pea_core.signals import SIGNAL, Column, columns_of
from pea_core.units import SECOND
from pea_wire import topics
from pea_wire.topics import AXIS, SAMPLED, Topic

ENCAPSULATION = b"\x00\x01\x00\x00"
"""CDR, little endian."""

MOST = 4096
"""Elements of a sequence of texts: more are no names."""

POINTS = 1 << 14
"""Points of a chunk of reference, that a running loop takes."""

RECORDED_POINTS = 1 << 17
"""Points of a chunk in a recording: a loop in wall time left one of all that was waiting."""

_FIELDS = ("position", "velocity", "effort")
_POINT_FIELDS = ("positions", "velocities", "accelerations")


class ConversionError(Exception):
    """A message that does not hold what its topic promises.

    Parameters
    ----------
    field : str
        Which part of it.
    rule : str
        What it is, and must be.
    topic : str
        Where it came from, as far as that is known.
    """

    def __init__(self, field: str, rule: str, topic: str = "") -> None:
        super().__init__(field, rule, topic)
        self.field, self.rule, self.topic = field, rule, topic

    def __str__(self) -> str:
        return ": ".join(part for part in (self.topic, self.field, self.rule) if part)


class JointState(NamedTuple):
    """Axes of a ``sensor_msgs/JointState``; NaN where the message leaves a field out.

    Attributes
    ----------
    stamp : int
        Nanoseconds.
    position, velocity, effort : float or tuple of float
        m, m/s, V.
    """

    stamp: int
    position: Any
    velocity: Any
    effort: Any


class Reader:
    """Reads CDR field by field; `ConversionError` where the bytes are none.

    Parameters
    ----------
    data : bytes
    field : str
        What is read first, for errors; set `field` before each part.
    """

    def __init__(self, data: bytes, field: str = "") -> None:
        self.field = "encapsulation"
        if len(data) < 4 or data[0] != 0 or data[1] > 1:
            raise self.wrong(f"{data[:4].hex() or 'nothing'}: must be that of plain CDR")
        self.order = "<" if data[1] else ">"
        self.data = data
        self.at = 4
        self.field = field

    def wrong(self, rule: str) -> ConversionError:
        """The error that the field breaks a rule."""
        return ConversionError(self.field, rule)

    def take(self, kind: str, size: int, count: int = 1) -> tuple:
        """Numbers of one kind, as `struct` names it, each of so many bytes."""
        if count:
            self.at += -(self.at - 4) % size
        end = self.at + size * count
        if end > len(self.data):
            raise self.wrong(f"message ends early: {len(self.data)} bytes, {end} are needed")
        values = struct.unpack_from(f"{self.order}{count}{kind}", self.data, self.at)
        self.at = end
        return values

    def u32(self) -> int:
        """A whole number."""
        return int(self.take("I", 4)[0])

    def count(self, most: int = MOST) -> int:
        """Length of a sequence that is read one by one."""
        found = self.u32()
        if found > most:
            raise self.wrong(f"{found} of them: must be at most {most}")
        return found

    def stamp(self) -> int:
        """A time (ns)."""
        return int(self.take("i", 4)[0]) * SECOND + self.u32()

    def text(self) -> str:
        """A string."""
        size = self.u32()
        letters = bytes(self.take("s", 1, size)[0] if size else b"").rstrip(b"\0")
        try:
            return letters.decode("utf-8")
        except UnicodeDecodeError:
            raise self.wrong(f"a text of {size} bytes is no UTF-8") from None

    def doubles(self) -> tuple:
        """A sequence of float64."""
        count = self.u32()
        return self.take("d", 8, count) if count else ()

    def names(self) -> list[str]:
        """A sequence of strings."""
        return [self.text() for _ in range(self.count())]


def _places(reader: Reader, axes: Sequence[str]) -> tuple[list[int], int]:
    """Places of the axes among the names that come next, and how many there are."""
    names = reader.names()
    if missing := [axis for axis in axes if axis not in names]:
        some = ", ".join(repr(name[:40]) for name in names[:4]) or "nothing"
        raise reader.wrong(f"{some}: must hold the axis {missing[0]!r}")
    return [names.index(axis) for axis in axes], len(names)


def axes_of(data: bytes, trajectory: bool = False) -> tuple[str, ...]:
    """Axes that a ``JointState``, or a ``JointTrajectory``, names.

    Raises
    ------
    ConversionError
        The bytes are no such message.
    """
    reader = Reader(data, "header")
    reader.stamp()
    reader.text()
    reader.field = "joint_names" if trajectory else "name"
    return tuple(reader.names())


class JointStateCodec:
    """Packs and reads the axes of a ``sensor_msgs/JointState``.

    Parameters
    ----------
    axes : tuple of str
        Names of the axes.
    position, velocity, effort : bool
        Which arrays the message carries.
    frame : str
        Its frame_id.
    """

    def __init__(
        self,
        axes: tuple[str, ...],
        *,
        position: bool = False,
        velocity: bool = False,
        effort: bool = False,
        frame: str = "",
    ) -> None:
        self.axes = axes
        self.carries = (position, velocity, effort)
        frame_id = frame.encode() + b"\0"
        body = struct.pack("<I", len(frame_id)) + frame_id
        body += bytes(-len(body) % 4)
        body += _names(axes)
        n = len(axes)
        fields: list[Any] = [
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
            constant += struct.pack("<I", n * present)
            at += 4
            if present:
                pad = -at % 8
                if pad:
                    fields.append((f"pad_{field}", f"V{pad}"))
                fields.append((field, "<f8") if n == 1 else (field, "<f8", (n,)))
                constant += bytes(pad)
                form += f"{len(constant)}s{n}d"
                texts.append(constant)
                constant = b""
                at += pad + 8 * n
        form += f"{len(constant)}s"
        texts.append(constant)
        self.dtype = np.dtype(fields)
        self._struct = struct.Struct(form)
        self._body = body
        self._texts = tuple(texts)
        blank: list[Any] = []
        for text in texts:
            blank += [text, *[0.0] * n]
        self._blank = blank[:-n]
        self._n = n
        self._places = tuple(sum(self.carries[:i]) if c else -1 for i, c in enumerate(self.carries))
        self.size = self._struct.size
        assert self.size == self.dtype.itemsize
        self._pack = self._struct.pack
        self._unpack = self._struct.unpack

    def encode(self, stamp: int, *values: Any) -> bytes:
        """One message at `stamp` (ns); `values` are the fields carried, in order."""
        parts = [ENCAPSULATION, *divmod(stamp, SECOND), *self._blank]
        if self._n == 1:
            parts[4::2] = values
        else:
            for at, value in zip(range(4, len(parts), self._n + 1), values, strict=True):
                parts[at : at + self._n] = value
        return self._pack(*parts)

    def decode(self, data: bytes) -> JointState:
        """Read one message.

        Raises
        ------
        ConversionError
            An axis is missing, or the bytes are no such message.
        """
        if len(data) == self.size:
            n = self._n
            head, sec, nanosec, *parts = self._unpack(data)
            if head == ENCAPSULATION and tuple(parts[:: n + 1]) == self._texts:
                a, b, c = self._places
                values: tuple[Any, ...]
                if n == 1:
                    values = (*parts[1::2], math.nan)
                else:
                    starts = range(1, len(parts), n + 1)
                    values = (*(tuple(parts[i : i + n]) for i in starts), (math.nan,) * n)
                return JointState(sec * SECOND + nanosec, values[a], values[b], values[c])
        return self._decode_any(data)

    def _decode_any(self, data: bytes) -> JointState:
        reader = Reader(data, "header")
        stamp = reader.stamp()
        reader.text()
        reader.field = "name"
        places, n = _places(reader, self.axes)
        found: list[Any] = []
        for reader.field in _FIELDS:
            values = reader.doubles()
            if len(values) not in (0, n):
                raise reader.wrong(f"{len(values)} numbers: must be one a name, {n}, or none")
            own = tuple(values[i] if values else math.nan for i in places)
            found.append(own[0] if self._n == 1 else own)
        return JointState(stamp, *found)

    def receive(self, data: bytes) -> JointState:
        """Read one message of which every field that the codec carries must be finite numbers.

        Raises
        ------
        ConversionError
            One is not, an axis is missing, or the bytes are no such message.
        """
        message = self.decode(data)
        for present, value, field in zip(self.carries, message[1:], _FIELDS):
            if present and not _finite(value):
                raise ConversionError(field, f"{value}: must be one finite number for each name")
        return message

    def encode_many(self, stamps: np.ndarray, *values: np.ndarray) -> np.ndarray:
        """Messages as a structured array whose bytes are the CDR of one message a row.

        Parameters
        ----------
        stamps : (n,) array of int64
            Nanoseconds.
        *values : (n,) arrays, or (n, axes)
            The fields carried, in order.
        """
        rows = np.zeros(len(stamps), self.dtype)
        rows["encapsulation"] = np.frombuffer(ENCAPSULATION, "V4")[0]
        rows["sec"], rows["nanosec"] = np.divmod(stamps, SECOND)
        rows["frame_and_name"] = np.frombuffer(self._body, f"V{len(self._body)}")[0]
        rest = iter(values)
        for field, present in zip(("position", "velocity", "effort"), self.carries):
            if present:
                rows[f"n_{field}"] = self._n
                rows[field] = next(rest)
        return rows


def _finite(value: Any) -> bool:
    """Whether a number is finite, or every one of several."""
    return all(map(math.isfinite, value)) if type(value) is tuple else math.isfinite(value)


def _names(axes: Sequence[str]) -> bytes:
    """CDR of a sequence of names, from a multiple of 4 to one."""
    data = struct.pack("<I", len(axes))
    for axis in axes:
        name = axis.encode() + b"\0"
        data += struct.pack("<I", len(name)) + name
        data += bytes(-len(data) % 4)
    return data


_POINT_MIN = 24
"""Bytes of a trajectory point without a number in it."""


def _point(n: int) -> tuple[np.dtype, np.dtype]:
    """A trajectory point of n axes that starts at a multiple of 8, and 4 bytes behind one."""
    fields: list[Any] = []
    for name, field in zip(_POINT_FIELDS, ("position", "velocity", "acceleration"), strict=True):
        fields += [(f"n_{name}", "<u4"), (f"pad_{name}", "V4")]
        fields.append((field, "<f8") if n == 1 else (field, "<f8", (n,)))
    fields += [("n_effort", "<u4"), ("sec", "<i4"), ("nanosec", "<u4")]
    shifted = [field for field in fields if field[0] != "pad_positions"]
    return np.dtype(fields), np.dtype(shifted)


class TrajectoryCodec:
    """Packs and reads the axes of a ``trajectory_msgs/JointTrajectory`` chunk.

    Points are rows of w (m), w_dot (m/s), w_ddot (m/s^2) of each axis: (n, axes x 3) arrays.

    Parameters
    ----------
    axes : tuple of str
        Names of the axes.
    """

    def __init__(self, axes: tuple[str, ...]) -> None:
        self.axes = axes
        self._n = len(axes)
        self._aligned, self._shifted = _point(self._n)
        body = struct.pack("<I", 1) + b"\0" + b"\0\0\0"
        self._body = body + _names(axes)

    def encode(self, stamp: int, period: int, points: np.ndarray) -> bytes:
        """One chunk.

        Parameters
        ----------
        stamp, period : int
            Time of the first point and distance of the points (ns).
        points : (n, axes x 3) array
            See the class.
        """
        sec, nanosec = divmod(stamp, SECOND)
        head = struct.pack("<iI", sec, nanosec) + self._body + struct.pack("<I", len(points))
        times = np.arange(len(points), dtype=np.int64) * period
        if len(head) % 8 == 0:
            first = self._points(self._aligned, times[:1], points[:1])
            rest = self._points(self._shifted, times[1:], points[1:])
            return ENCAPSULATION + head + first + rest
        return ENCAPSULATION + head + self._points(self._shifted, times, points)

    def _each(self) -> np.dtype:
        """Layout of a message of one point."""
        point = self._shifted if (12 + len(self._body)) % 8 else self._aligned
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
        *values : (n,) arrays, or (n, axes)
            w (m), w_dot (m/s), w_ddot (m/s^2).
        """
        one = self.encode(0, 0, np.zeros((1, 3 * self._n)))
        rows = np.frombuffer(bytearray(one * len(stamps)), self._each())
        rows["sec"], rows["nanosec"] = np.divmod(stamps, SECOND)
        for field, value in zip(("position", "velocity", "acceleration"), values, strict=True):
            rows["point"][field] = value
        return rows

    def decode_each(self, payload: bytes) -> np.ndarray:
        """w (m) of messages from `encode_each`, one behind the other: (n,) or (n, axes) array.

        Raises
        ------
        ConversionError
            They are no such messages.
        """
        layout = self._each()
        if len(payload) % layout.itemsize:
            raise ConversionError("data", "must be messages of one point each")
        w: np.ndarray = np.frombuffer(payload, layout)["point"]["position"]
        return w

    def _points(self, dtype: np.dtype, times: np.ndarray, points: np.ndarray) -> bytes:
        rows = np.zeros(len(points), dtype)
        for i, field in enumerate(("position", "velocity", "acceleration")):
            rows[field] = points[:, i] if self._n == 1 else points[:, i::3]
        for count in ("n_positions", "n_velocities", "n_accelerations"):
            rows[count] = self._n
        rows["sec"], rows["nanosec"] = np.divmod(times, SECOND)
        return rows.tobytes()

    def decode(
        self, data: bytes, most: int = RECORDED_POINTS
    ) -> tuple[int, np.ndarray, np.ndarray]:
        """Read one chunk of at most `most` points.

        Returns
        -------
        int
            Stamp of the message (ns).
        (n,) array of int64
            Time of each point after the stamp (ns).
        (n, axes x 3) array
            See the class.

        Raises
        ------
        ConversionError
            An axis is missing, a point lacks a derivative, or the bytes are no such message.
        """
        reader = Reader(data, "header")
        stamp = reader.stamp()
        reader.text()
        reader.field = "joint_names"
        places, _ = _places(reader, self.axes)
        reader.field = "points"
        n = reader.count(most)
        if n * _POINT_MIN > len(data) - reader.at:
            raise reader.wrong(f"message ends early: {n} points in {len(data)} bytes")
        plain = reader.order == "<" and places == list(range(self._n))
        fast = self._decode_fixed(data, reader.at, n) if plain else None
        if fast is not None:
            return stamp, *fast
        times = np.empty(n, np.int64)
        points = np.empty((n, 3 * self._n))
        for row in range(n):
            reader.field = f"points[{row}]"
            fields = [reader.doubles() for _ in range(3)]
            reader.doubles()
            if any(len(f) <= max(places) for f in fields):
                raise reader.wrong("must hold position, velocity and acceleration of the axis")
            points[row] = [f[i] for i in places for f in fields]
            times[row] = reader.stamp()
        return stamp, times, points

    def receive(self, data: bytes) -> tuple[int, np.ndarray, np.ndarray]:
        """Read one chunk of 1 to `POINTS` points, of finite numbers alone; see `decode`.

        Raises
        ------
        ConversionError
            It does not, or the bytes are no such message.
        """
        stamp, times, points = self.decode(data, POINTS)
        if not len(points):
            raise ConversionError("points", "none: must be one at least")
        wrong = np.flatnonzero(~np.isfinite(points).all(1))
        if len(wrong):
            raise ConversionError(
                f"points[{wrong[0]}]", f"{points[wrong[0]].tolist()}: must be finite numbers"
            )
        return stamp, times, points

    def _decode_fixed(self, data: bytes, at: int, n: int) -> tuple[np.ndarray, np.ndarray] | None:
        if n == 0:
            return np.empty(0, np.int64), np.empty((0, 3 * self._n))
        first = self._aligned if (at - 4) % 8 == 0 else self._shifted
        if at + first.itemsize + (n - 1) * self._shifted.itemsize > len(data):
            return None
        parts = [
            np.frombuffer(data, first, 1, at),
            np.frombuffer(data, self._shifted, n - 1, at + first.itemsize),
        ]
        counts = ("n_positions", "n_velocities", "n_accelerations")
        if any((p[c] != self._n).any() for p in parts for c in counts) or any(
            p["n_effort"].any() for p in parts
        ):
            return None

        def column(field: str) -> np.ndarray:
            return np.concatenate([p[field] for p in parts])

        times = column("sec").astype(np.int64) * SECOND + column("nanosec")
        fields = [column(f) for f in ("position", "velocity", "acceleration")]
        return times, np.stack(fields, axis=-1).reshape(n, -1)


def place(column: Column) -> int:
    """Place of a signal among the three numbers of a message that its codec has read."""
    fields = _FIELDS if column.field in _FIELDS else _POINT_FIELDS
    return fields.index(column.field)


class Forms:
    """Codecs of the topics of a loop with some axes.

    Parameters
    ----------
    axes : tuple of str
        Their names.

    Attributes
    ----------
    codecs : dict of Topic to (JointStateCodec, JointStateCodec)
        Of each topic of `topics.SAMPLED`: without what is optional, and with it.
    displacement, displacement_ideal, state, voltage : JointStateCodec
        Of `topics.DISPLACEMENT`, without and with the true velocity of an ideal sensor, and so on.
    reference : TrajectoryCodec
        Of `topics.REFERENCE`.
    marked : dict of str to JointStateCodec
        Of `topics.DISPLACEMENT` between two samples of a loop: to look at, not to answer.
    """

    def __init__(self, axes: tuple[str, ...]) -> None:
        self.axes = axes
        self.codecs = {topic: self._codecs(topic) for topic in SAMPLED}
        self.displacement, self.displacement_ideal = self.codecs[topics.DISPLACEMENT]
        self.state, self.voltage = (self.codecs[t][0] for t in (topics.STATE, topics.VOLTAGE))
        self.reference = TrajectoryCodec(axes)
        self.marked = {name: self._codecs(topics.DISPLACEMENT, name)[0] for name in MARKS}

    def _codecs(self, topic: Topic, frame: str = "") -> tuple[JointStateCodec, JointStateCodec]:
        columns = columns_of(topic.relative)
        lean = tuple(column.field for column in columns if not column.optional)
        whole = tuple(column.field for column in columns)
        made = {
            fields: JointStateCodec(self.axes, frame=frame, **dict.fromkeys(fields, True))
            for fields in (lean, whole)
        }
        return made[lean], made[whole]

    def messages(self, topic: Topic, stamps: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """CDR of the messages of a topic of `topics.SAMPLED`, as a structured array of one a row.

        Parameters
        ----------
        topic : Topic
        stamps : (n,) array of int64
            Nanoseconds.
        rows : (n,) or (n, axes) array of `SAMPLE`
        """
        columns = columns_of(topic.relative)
        whole = not any(np.isnan(rows[column.name]).any() for column in columns if column.optional)
        values = [rows[column.name] for column in columns if whole or not column.optional]
        return self.codecs[topic][whole].encode_many(stamps, *values)

    def points(self, rows: np.ndarray) -> np.ndarray:
        """The reference in rows of `SAMPLE`, as (n, axes x 3) array."""
        columns = columns_of(topics.REFERENCE.relative)
        points = np.stack([rows[column.name] for column in columns], axis=-1)
        return points.reshape(len(rows), -1)

    def decode_displacement(self, data: bytes) -> JointState:
        """Read `topics.DISPLACEMENT`, of an ideal sensor or another.

        Raises
        ------
        ConversionError
            An axis is missing, a number is not finite, or the bytes are no such message.
        """
        ideal = len(data) == self.displacement_ideal.size
        message = (self.displacement_ideal if ideal else self.displacement).decode(data)
        if not (_finite(message.position) and _finite(message.effort)):
            return self.displacement.receive(data)  # says which
        return message


DETECTED = JointStateCodec((SIGNAL.name,), position=SIGNAL.field == "position")
"""Codec of `topics.SIGNAL`."""

MARKS = ("inactive", "fault")
"""States of a plant's gate in which it shows where the stage is between two samples of a loop."""


_forms = cache(Forms)


def forms(axes: tuple[str, ...] = (AXIS,)) -> Forms:
    """The codecs of a loop with some axes, the same each time."""
    return _forms(axes)


def marked(data: bytes) -> str:
    """State of the plant's gate in which a displacement is no sample of the loop, else empty.

    Raises
    ------
    ConversionError
        The bytes are no such message.
    """
    if data[12:13] <= b"\x01":  # no frame_id
        return ""
    reader = Reader(data)
    reader.stamp()
    frame = reader.text()
    return frame if frame in MARKS else ""


LAST = 2**31 * SECOND
"""First stamp (ns) that no message can hold."""

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
        return int(sec * SECOND + nanosec)
    return Reader(data, "stamp").stamp()


def stamps(payload: bytes, size: int) -> np.ndarray:
    """Stamps (ns) of messages that begin with a header: (n,) array of int64.

    Parameters
    ----------
    payload : bytes
        The messages, one behind the other, as of `decode_block`.
    size : int
        Bytes of each.
    """
    rows = np.frombuffer(payload, np.uint8).reshape(-1, size)
    sec, nanosec = rows[:, 4:8].copy().view("<i4"), rows[:, 8:12].copy().view("<u4")
    return sec[:, 0].astype(np.int64) * SECOND + nanosec[:, 0]


def encode_time(stamp: int) -> bytes:
    """``builtin_interfaces/Time`` of `stamp` (ns)."""
    return _TIME.pack(ENCAPSULATION, *divmod(stamp, SECOND))


def decode_time(data: bytes) -> int:
    """Stamp (ns) of a ``builtin_interfaces/Time``.

    Raises
    ------
    ConversionError
        It is too short, or no CDR.
    """
    return Reader(data, "time").stamp()


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
    reader = Reader(data, "layout")
    sizes = []
    for _ in range(reader.count()):
        reader.text()
        sizes.append((reader.u32(), reader.u32()))
    reader.u32()
    reader.field = "data"
    count = reader.u32()
    payload = bytes(reader.take("s", 1, count)[0]) if count else b""
    if len(sizes) != 2 or sizes[0][0] * sizes[1][0] != count or sizes[1][0] < _TIME.size:
        said = " of ".join(str(n) for n, _ in sizes[:4])
        raise reader.wrong(f"{count} bytes, {said or 'no layout'}: must be messages of equal size")
    size = sizes[1][0]
    heads = np.frombuffer(payload, np.uint8).reshape(-1, size)[:, : len(ENCAPSULATION)]
    if not count or (heads != np.frombuffer(ENCAPSULATION, np.uint8)).any():
        raise reader.wrong("must be messages of plain CDR, little endian, one at least")
    return size, payload


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
