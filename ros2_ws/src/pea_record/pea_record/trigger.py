"""Triggered recordings: the bag holds only the samples around each trigger.

The recorder holds the last `pre` seconds in memory. When the trigger fires at t, it writes the
window from t - pre to t + post at full rate; a trigger within a window extends it. Each window is a
separate file, which is a valid bag by itself. Between windows only changes of parameters and
transitions of the safety gate are written. Metadata records of the bag name every window.
"""

from __future__ import annotations

import contextlib
import math
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pea_core.axes import POINT
from pea_core.params import ParameterError, nearest
from pea_core.signals import COARSE, COLUMNS, column_of
from pea_core.units import NM_PER_M, NS, SECOND
from pea_record.bag import WHOLE, BagWriter, Split
from pea_record.messages import diagnostics
from pea_record.read import files_of
from pea_record.recording import BagError
from pea_record.tape import Tape
from pea_wire import convert
from pea_wire.topics import (
    DIAGNOSTICS,
    DISPLACEMENT,
    PARAMETER_EVENTS,
    REFERENCE,
    SAMPLED,
    Topic,
)

ERRORS = ("error", "abs_error")
"""y - w, and its absolute value."""

MESSAGES = ("trip", "parameter")
"""Messages: a trip of the safety gate, a change of a parameter."""

SCANNED = ("frame", "line", "pixel", "point")
"""Events of a scan."""

SIGNALS = ("w", *(c.name for c in COLUMNS if c.topic != REFERENCE.relative), *ERRORS)
SOURCES = (*SIGNALS, *MESSAGES, *SCANNED)
EDGES = ("rising", "falling", "either", "above", "below")

TRIGGER = "pea_trigger"
"""Name of the bag's metadata record with its trigger."""

WINDOWED = "pea_window_"
"""Prefix of the names of the windows' metadata records; the number of the window follows."""

LATE = SECOND
"""Largest delay (ns of loop time) of a message of a trip or a parameter after its samples."""

CHUNK = 1000
"""Points in a message of the reference."""

LONGEST = 600.0
"""Longest time (s) that is held in memory."""

NO_SCAN = "the reference is no scan; give it one, as reference.type=raster, or another source"

Events = Callable[[int, int], np.ndarray]
"""Events of the scan that begin at samples first to last - 1 (`pea_reference.model.scan`)."""


def no_events(first: int, last: int) -> np.ndarray:
    """No events: the scan is not known yet."""
    return np.empty(0, [("k", np.int64), ("kind", np.uint8)])


class Trigger(NamedTuple):
    """The trigger of a recording.

    Attributes
    ----------
    source : str
        One of `SOURCES`. With several axes, a signal of any axis fires; ``x.error`` is only that
        of x.
    level : float
        In the unit of `unit_of`; NaN if the source is no signal.
    edge : str
        One of `EDGES`: a crossing of the level, or every sample on one side of it.
    pre, post : float
        Seconds to keep before and after the trigger.
    """

    source: str
    level: float = math.nan
    edge: str = "rising"
    pre: float = 0.1
    post: float = 0.1


def split(source: str) -> tuple[str, str]:
    """Axis of a source (empty: any axis) and its name; ``x.error`` is the error of x."""
    axis, _, name = source.rpartition(".")
    return axis, name


def unit_of(source: str) -> tuple[str, float]:
    """Unit of a signal's level, and its number in one SI unit."""
    source = split(source)[1]
    return ("nm", NM_PER_M) if source in ERRORS else COARSE[column_of(source).unit]


def trigger_of(
    source: str | None,
    level: float | None,
    edge: str | None,
    pre: float | None,
    post: float | None,
    name: Callable[[str], str] = lambda part: f"trigger_{part}",
) -> Trigger | None:
    """The trigger that parameters define; None without a source.

    Parameters
    ----------
    source, level, edge, pre, post
        None if not given.
    name : callable
        Name of a parameter in errors.

    Raises
    ------
    ParameterError
        One of them is unknown, out of range, or does not match the source.
    """
    given = {"level": level, "edge": edge, "pre": pre, "post": post}
    if not source:
        for part, value in given.items():
            if value is not None:
                raise ParameterError(f"{name(part)} = {value}: has no source; add {name('source')}")
        return None
    axis, plain = split(source)
    if plain not in SOURCES:
        raise ParameterError(f"{name('source')} = {source!r}: {nearest(plain, SOURCES)}")
    if axis and plain not in SIGNALS:
        raise ParameterError(f"{name('source')} = {source!r}: {plain} is of all axes; give {plain}")
    if edge is not None and edge not in EDGES:
        raise ParameterError(f"{name('edge')} = {edge!r}: {nearest(edge, EDGES)}")
    if plain in SIGNALS:
        if level is None:
            raise ParameterError(
                f"{name('source')} = {source!r}: needs a level; add {name('level')} in "
                f"{unit_of(source)[0]}"
            )
    else:
        for part in ("level", "edge"):
            if given[part] is not None:
                raise ParameterError(
                    f"{name(part)} = {given[part]}: {source} is no signal; omit it, or give "
                    f"{name('source')} one of {', '.join(SIGNALS)}"
                )
    for part in ("pre", "post"):
        seconds = given[part]
        if seconds is not None and not 0.0 <= float(seconds) <= LONGEST:
            raise ParameterError(f"{name(part)} = {seconds}: must be 0 to {LONGEST:g} s")
    return Trigger(
        source,
        math.nan if level is None else level,
        edge or "rising",
        0.1 if pre is None else pre,
        0.1 if post is None else post,
    )


def fired(values: np.ndarray, before: float, level: float, edge: str) -> np.ndarray:
    """Samples at which a signal fires: (n,) array of bool.

    Parameters
    ----------
    values : (n,) array
    before : float
        The sample before them; NaN if there is none.
    level : float
    edge : str
        One of `EDGES`.
    """
    earlier = np.concatenate([[before], values[:-1]])
    found: dict[str, np.ndarray] = {
        "rising": (earlier < level) & (values >= level),
        "falling": (earlier > level) & (values <= level),
        "above": values >= level,
        "below": values <= level,
    }
    result: np.ndarray = found["rising"] | found["falling"] if edge == "either" else found[edge]
    return result


class Window(NamedTuple):
    """First and last stamp (ns), and the stamp at which it was first triggered."""

    begin: int
    end: int
    fired: int


class TriggeredBag(BagWriter):
    """A bag that keeps the windows of a trigger; it is used as a `BagWriter`.

    Parameters
    ----------
    directory, T_ns, files
        As of `BagWriter`, which calls the last one split; the sample period must be known.
    trigger : Trigger
    events : callable, optional
        `Events` of the scan, if the source is an event.

    Attributes
    ----------
    windows : int
        Number of windows so far.
    seen, kept : int
        Number of samples that were received, and that were written.
    """

    def __init__(
        self,
        directory: Path,
        T_ns: int,
        files: Split,
        trigger: Trigger,
        events: Events | None = None,
    ) -> None:
        self.trigger = trigger
        self.events = events
        self.windows = self.seen = self.kept = 0
        self._pre, self._post = (round(s * SECOND / T_ns) * T_ns for s in trigger[3:])
        self._held: dict[str, deque[tuple[np.ndarray, np.ndarray]]] = {
            topic.name: deque() for topic in SAMPLED
        }
        self._beside: deque[tuple[int, Topic, bytes]] = deque()
        self._points: deque[tuple[np.ndarray, np.ndarray]] = deque()
        self._received = dict.fromkeys((*self._held, REFERENCE.name), -1)
        self._looked = self._written = -T_ns
        self._before: np.ndarray | None = None
        self._forms: convert.Forms | None = None
        self._open: deque[Window] = deque()
        self._ended = False
        super().__init__(directory, T_ns, files)
        told = {n: str(v) for n, v in trigger._asdict().items()}
        if split(trigger.source)[1] in SIGNALS:
            told["unit"] = unit_of(trigger.source)[0]
        self.metadata(TRIGGER, told)

    def write(self, topic: Topic, stamp: int, data: bytes) -> None:
        """Write or hold one message; see `BagWriter.write`."""
        if topic == REFERENCE:
            first, times, points = self._form(data, True).reference.decode(data)
            stamps = first + times
            if len(stamps):
                self._points.append((stamps, points))
                self._received[topic.name] = max(self._received[topic.name], int(stamps[-1]))
        elif topic in SAMPLED:
            self.write_many(topic, np.array([stamp]), np.frombuffer(data, f"V{len(data)}"))
            return
        elif topic == PARAMETER_EVENTS:
            super().write(topic, stamp, data)
            if self.trigger.source == "parameter":
                self._fire(np.array([stamp]))
        elif topic == DIAGNOSTICS and b"plant: safety" in data:
            super().write(topic, stamp, data)
            if self.trigger.source == "trip" and b"-> fault" in data:
                self._fire(np.array([stamp]))
        else:
            self._beside.append((stamp, topic, data))
        self._advance()

    def write_many(self, topic: Topic, stamps: np.ndarray, rows: np.ndarray) -> None:
        """Write or hold messages of equal size; see `BagWriter.write_many`."""
        if not len(stamps):
            return
        if topic not in SAMPLED:
            rows = np.ascontiguousarray(rows)
            self._beside += [(int(t), topic, row.tobytes()) for t, row in zip(stamps, rows)]
            return
        self._held[topic.name].append((np.array(stamps), np.array(rows)))
        self._received[topic.name] = int(stamps[-1])
        if topic == DISPLACEMENT:
            self.seen += len(stamps)
        self._advance()

    def _advance(self, ends: bool = False) -> None:
        """Check the received samples, write those of a window, drop the others."""
        common = min(self._received.values())
        if ends:
            common = min(self._received[topic.name] for topic in SAMPLED)
        if common < 0:
            return
        self._look(common, ends)
        decided = self._looked - self._pre - self.T_ns
        if ends:
            decided = common
        elif self._open:
            decided = min(max(decided, self._open[-1].end), common)
        while self._open:
            window = self._open[0]
            until = min(window.end, decided)
            self._keep(max(window.begin, self._written + self.T_ns), until)
            if not ends and self._looked - self._pre <= window.end:
                break
            self._open.popleft()
            self._complete_window(window, until)
        self._forget(min(decided, self._looked))

    def _look(self, common: int, ends: bool) -> None:
        """Search the samples up to a stamp for the trigger."""
        source = self.trigger.source
        if source in MESSAGES:
            self._looked = max(self._looked, common if ends else common - LATE)
        elif common <= self._looked:
            return
        elif source in SCANNED:
            if self.events is not None:
                first, last = (stamp // self.T_ns + 1 for stamp in (self._looked, common))
                found = self.events(max(first, 0), last)
                self._fire(found[found["kind"] == SCANNED.index(source)]["k"] * self.T_ns)
            self._looked = common
        else:
            self._fire(self._passages(common))
            self._looked = common

    def _passages(self, common: int) -> np.ndarray:
        """Stamps up to `common`, not looked at before, at which the signal fires."""
        axis, source = split(self.trigger.source)
        scale = unit_of(source)[1]
        if source == "w":
            stamps, points = _between(self._points, self._looked, common)
            values = points[:, ::POINT]
        else:
            column = column_of("y" if source in ERRORS else source)
            topic = next(t for t in SAMPLED if t.relative == column.topic)
            found = [
                (s[inside], self._values(topic, rows[inside], column.field))
                for s, rows in _recent(self._held[topic.name], self._looked)
                if (inside := (s > self._looked) & (s <= common)).any()
            ]
            if not found:
                return np.empty(0, np.int64)
            stamps, values = (np.concatenate(parts) for parts in zip(*found, strict=True))
            if source in ERRORS:
                known, points = _between(self._points, self._looked, common)
                stamps, here, there = np.intersect1d(stamps, known, return_indices=True)
                values = values[here] - points[there, ::POINT]
        if not len(stamps):
            return np.empty(0, np.int64)
        if axis and self._forms is not None:
            values = values[:, [self._forms.axes.index(axis)]]
        values = (np.abs(values) if source == "abs_error" else values) * scale
        before = np.full(values.shape[1], math.nan) if self._before is None else self._before
        level, edge = self.trigger.level, self.trigger.edge
        each = [fired(own, float(last), level, edge) for own, last in zip(values.T, before)]
        self._before = values[-1]
        hits: np.ndarray = stamps[np.any(each, axis=0)]
        return hits

    def _form(self, data: bytes, trajectory: bool = False) -> convert.Forms:
        """Codecs of the loop, whose axes the first message names."""
        if self._forms is None:
            self._forms = convert.forms(convert.axes_of(data, trajectory))
        return self._forms

    def _values(self, topic: Topic, rows: np.ndarray, field: str) -> np.ndarray:
        """A field of messages, (n, axes) array; NaN where they leave it out."""
        forms = self._form(rows[0].tobytes())
        shape = len(rows), len(forms.axes)
        for codec in forms.codecs[topic]:
            if rows.dtype.itemsize == codec.size:
                fields = rows.view(codec.dtype)
                if field not in (fields.dtype.names or ()):
                    return np.full(shape, math.nan)
                return np.array(fields[field]).reshape(shape)
        decode = forms.codecs[topic][0].decode
        read = [getattr(decode(row.tobytes()), field) for row in rows]
        return np.array(read, float).reshape(shape)

    def _fire(self, stamps: np.ndarray) -> None:
        """Open a window for triggers at stamps that rise, or make the last one longer."""
        if not len(stamps):
            return
        breaks = np.flatnonzero(np.diff(stamps) > self._pre + self._post + self.T_ns) + 1
        for group in np.split(np.asarray(stamps, np.int64), breaks):
            begin = max(int(group[0]) - self._pre, self._written + self.T_ns, 0)
            end = int(group[-1]) + self._post
            if self._open and begin <= self._open[-1].end + self.T_ns:
                self._open[-1] = self._open[-1]._replace(end=max(end, self._open[-1].end))
            elif end >= begin:
                self._open.append(Window(begin, end, int(group[0])))

    def _keep(self, begin: int, end: int) -> None:
        """Write the samples from one stamp to another."""
        if end < begin:
            return
        stamps, points = _between(self._points, begin - 1, end)
        for k in range(0, len(stamps), CHUNK):
            part = slice(k, k + CHUNK)
            first = int(stamps[k])
            assert self._forms is not None
            data = self._forms.reference.encode(first, self.T_ns, points[part])
            super().write(REFERENCE, first, data)
        for topic in SAMPLED:
            for held, rows in _recent(self._held[topic.name], begin - 1):
                inside = (held >= begin) & (held <= end)
                if inside.any():
                    super().write_many(topic, held[inside], rows[inside])
                    self.kept += int(inside.sum()) if topic == DISPLACEMENT else 0
        for stamp, topic, data in self._beside:
            if begin <= stamp <= end:
                super().write(topic, stamp, data)
        self._written = end

    def _complete_window(self, window: Window, until: int) -> None:
        """Note a window; what comes next begins a new file."""
        facts = {"begin_ns": window.begin, "end_ns": until, "fired_ns": window.fired}
        told = {name: str(value) for name, value in facts.items()}
        self.flush()
        self._file.mcap.metadata(f"{WINDOWED}{self.windows}", told)
        self.windows += 1
        self._full = self._ended = True

    def _forget(self, until: int) -> None:
        """Leave out what no window can hold any more."""
        for held in (*self._held.values(), self._points):
            while held and held[0][0][-1] <= until:
                held.popleft()
        while self._beside and self._beside[0][0] <= until:
            self._beside.popleft()

    def keep(self) -> None:
        """Bring what is written into the file now and then; see `BagWriter.keep`."""
        ended = self._ended
        super().keep()
        self._full = self._full or ended

    def _go_on(self) -> None:
        super()._go_on()
        if self._ended:
            self._ended = False
            self._since = -1  # the time between two windows is not in the file
            self._seen = {name: type(seen)() for name, seen in self._seen.items()}

    def close(self) -> None:
        """Write what is left of an open window, and complete the bag."""
        if not self._file.file.closed and self._file.mcap.failed is None:
            self._advance(ends=True)
        super().close()

    def said(self) -> str:
        """One line on what was kept."""
        return (
            f"trigger {self.trigger.source}: {self.windows} windows, {self.kept} of {self.seen} "
            "samples kept"
        )


Held = deque[tuple[np.ndarray, np.ndarray]]
"""Stamps and rows of blocks, in order."""


def _recent(held: Held, after: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Blocks that reach beyond a stamp; the many that do not are not looked at."""
    found = []
    for block in reversed(held):
        if block[0][-1] <= after:
            break
        found.append(block)
    return found[::-1]


def _between(held: Held, after: int, until: int) -> tuple[np.ndarray, np.ndarray]:
    """Stamps and rows in (after, until], each stamp once."""
    parts = [(s, v) for s, v in _recent(held, after) if s[0] <= until]
    if not parts:
        return np.empty(0, np.int64), np.empty((0, 3))
    stamps, values = (np.concatenate(each) for each in zip(*parts, strict=True))
    stamps, index = np.unique(stamps, return_index=True)
    inside = (stamps > after) & (stamps <= until)
    return stamps[inside], values[index][inside]


def opened(
    directory: Path,
    T_ns: int,
    split: Split = WHOLE,
    trigger: Trigger | None = None,
    events: Events | None = None,
) -> BagWriter:
    """A bag that keeps everything, or the windows of a trigger.

    Raises
    ------
    ParameterError
        The source is an event of a scan, and the reference is none.
    OSError, DefinitionError
        As `BagWriter`.
    """
    if trigger is None:
        return BagWriter(directory, T_ns, split)
    if trigger.source in SCANNED and events is None:
        raise ParameterError(f"trigger source {trigger.source!r}: {NO_SCAN}")
    return TriggeredBag(directory, T_ns, split, trigger, events)


def windows(metadata: dict[str, dict[str, str]]) -> list[Window]:
    """Windows that a triggered recording says it has, by number; empty where it is not one."""
    names = [n for n in metadata if n.startswith(WINDOWED) and n[len(WINDOWED) :].isdecimal()]
    found = []
    for name in sorted(names, key=lambda n: int(n[len(WINDOWED) :])):
        values = metadata[name]
        try:
            found.append(Window(*(int(values[f"{part}_ns"]) for part in Window._fields)))
        except (KeyError, ValueError):  # of a writer of another version
            continue
    return found


def lacking(metadata: dict[str, dict[str, str]], stamps: np.ndarray, T_ns: int) -> list[str]:
    """What is missing in the windows of a triggered recording: a line for each."""
    found = []
    for number, window in enumerate(windows(metadata)):
        wanted = (window.end - window.begin) // T_ns + 1
        first, last = np.searchsorted(stamps, [window.begin, window.end + 1])
        if wanted != last - first:
            span = f"{window.begin * NS:.6f} s to {window.end * NS:.6f} s"
            found.append(f"window {number}, {span}: {wanted - (last - first)} samples are missing")
    return found


def kept(directory: Path) -> tuple[dict[str, dict[str, str]], str | None]:
    """Records of a triggered recording, be there no sample, and what has tripped the gate."""
    tape = Tape()
    for file in files_of(directory):
        tape.read(file)
    trip = None
    with contextlib.suppress(BagError):  # holds no message
        for _, status in diagnostics(directory):
            values = {pair.key: pair.value for pair in status.values}
            if values.get("after") == "fault":
                trip = values["cause"]
    return tape.metadata, trip
