"""The last samples of a loop at full rate, in memory that does not grow."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence

import numpy as np

from pea_core.signals import columns_of
from pea_wire.topics import LOOP

CAPACITY = 2**18
"""Samples kept: 13 s at 20 kHz."""

MARGIN = 2**13
"""Of them, those that what is sent ahead may overwrite."""

SHOWN = ("w", "y", "u", "u_applied", "x1_hat", "eps_hat")
"""Signals of a sample that a dashboard shows."""

SOURCES = {
    topic.relative: tuple(c.name for c in columns_of(topic.relative) if c.name in SHOWN)
    for topic in LOOP
}
"""Signals (SI) that come together, by the topic that they come from."""

AHEAD = "reference"
"""Source that is sent ahead, or not seen from the beginning: samples are complete without it."""


ALONG = {"reference": "w", "displacement": "y"}
"""Signals of a path, by the source that they come from."""


class Trace:
    """A ring of samples, each with all its signals; one thread writes, others read.

    Parameters
    ----------
    capacity : int
        Samples kept.
    sources : mapping of str to tuple of str
        Signals that come together, by their source: `AHEAD`, `displacement` and others.
    found : tuple of str
        Signals that `fill` adds.

    Attributes
    ----------
    T_ns : int
        Sample period (ns); 0 as long as it is not known.
    unseen : int
        Samples of `displacement` that have not come here, since the first that has.
    run : int
        Counts the runs seen: it changes where time began anew.
    """

    def __init__(
        self,
        capacity: int = CAPACITY,
        sources: Mapping[str, tuple[str, ...]] = SOURCES,
        found: tuple[str, ...] = ("eps",),
    ) -> None:
        self.capacity = capacity
        self.sources = sources
        self.found = found
        self._lock = threading.RLock()
        self.signals = (*(name for names in sources.values() for name in names), *found)
        self._rings = {name: np.full(capacity, np.nan) for name in self.signals}
        self.run = 0
        self.clear()

    def clear(self) -> None:
        """Forget all."""
        with self._lock:
            for ring in self._rings.values():
                ring.fill(np.nan)
            self.T_ns = 0
            self.unseen = 0
            self.run += 1
            self._first: dict[str, int] = {}
            self._end: dict[str, int] = {}

    def put(self, source: str, stamps: np.ndarray, values: Mapping[str, np.ndarray]) -> None:
        """Take samples of one source.

        Parameters
        ----------
        source : str
            One of `sources`.
        stamps : (n,) array of int64
            Their loop time (ns), ascending.
        values : mapping of str to (n,) arrays
            SI.

        Raises
        ------
        ValueError
            The stamps are not those of one sample after the other.
        """
        if not len(stamps):
            return
        if stamps[0] < 0 or (len(stamps) > 1 and np.diff(stamps).min() <= 0):
            raise ValueError(f"stamps of {source} must ascend from 0 on")
        with self._lock:
            if not self.T_ns:
                if len(stamps) < 2:
                    return
                self.T_ns = int(stamps[1] - stamps[0])
            k = stamps // self.T_ns
            first, last = int(k[0]), int(k[-1])
            end = self._end.get(source, first)
            if last < end:  # time began anew
                self.clear()
                self.put(source, stamps, values)
                return
            if first > end:
                if source == "displacement":
                    self.unseen += first - end
                self._blank(source, end, first)
            self._first.setdefault(source, first)
            slots = k % self.capacity
            for name in self.sources[source]:
                self._rings[name][slots] = values[name]
            if source == "displacement":
                self.unseen += last + 1 - first - len(k)
                for name in self.found:
                    self._rings[name][slots] = np.nan
                for name in self.sources[AHEAD]:
                    self._rings[name][slots[k >= self._end.get(AHEAD, 0)]] = np.nan
            self._end[source] = max(end, last + 1)

    def fill(self, run: int, k: np.ndarray, name: str, values: np.ndarray) -> None:
        """Add what was found out about samples.

        Parameters
        ----------
        run : int
            The run that they are of; nothing is added to another.
        k : (n,) array of int
            Their numbers.
        name : str
            Of `signals`.
        values : (n,) array
        """
        with self._lock:
            if run == self.run:
                there = (k >= self.first) & (k < self.end)
                self._rings[name][k[there] % self.capacity] = values[there]

    def _blank(self, source: str, start: int, end: int) -> None:
        """Say that samples are not known."""
        start = max(start, end - self.capacity)
        slots = np.arange(start, end) % self.capacity
        for name in self.sources[source]:
            self._rings[name][slots] = np.nan

    @property
    def end(self) -> int:
        """One after the last complete sample; 0 where there is none."""
        ends = [self._end.get(source) for source in self.sources if source != AHEAD]
        if None in ends:
            return 0
        end = min(each for each in ends if each is not None)
        if self._first.get(AHEAD, end) < end:
            end = min(end, self._end[AHEAD])
        return end

    @property
    def first(self) -> int:
        """First sample that is still there."""
        firsts = [self._first.get(source) for source in self.sources if source != AHEAD]
        if None in firsts:
            return 0
        came = max(each for each in firsts if each is not None)
        newest = max(end for source, end in self._end.items() if source != AHEAD)
        return max(came, newest - self.capacity + MARGIN)

    @property
    def unbroken(self) -> int:
        """First sample from which on none is missing."""
        with self._lock:
            table = self.samples(self.first, self.end, "u", "y")
            holes = np.flatnonzero(np.isnan(table["u"]) | np.isnan(table["y"]))
            return int(table["k"][holes[-1]]) + 1 if len(holes) else self.first

    def samples(self, start: int, end: int, *names: str) -> dict[str, np.ndarray]:
        """Signals of the samples from `start` to before `end` that are there; `k` with them.

        Parameters
        ----------
        start, end : int
            Numbers of samples.
        *names : str
            Of `signals`; all of them where none is named.
        """
        with self._lock:
            start, end = max(start, self.first), min(end, self.end)
            k = np.arange(start, max(end, start))
            slots = k % self.capacity
            wanted = names or self.signals
            return {"k": k, **{name: self._rings[name][slots] for name in wanted}}


def path(axes: Sequence[str], capacity: int = CAPACITY) -> Trace:
    """A trace of what each axis shall do and does: its signals are ``AXIS.w`` and ``AXIS.y``."""
    sources = {source: tuple(f"{axis}.{name}" for axis in axes) for source, name in ALONG.items()}
    return Trace(capacity, sources, ())
