"""The last samples of a loop at full rate, in memory that does not grow."""

from __future__ import annotations

import threading
from collections.abc import Mapping

import numpy as np

CAPACITY = 2**18
"""Samples kept: 13 s at 20 kHz."""

SOURCES = {
    "displacement": ("y", "u_applied"),
    "state": ("x1_hat", "eps_hat"),
    "voltage": ("u",),
    "reference": ("w",),
}
"""Signals (SI) that come together, by where they come from."""

SIGNALS = (*(name for names in SOURCES.values() for name in names), "eps")
"""All, with the truth that is found out here."""

SQUARES = "squares"
"""Sum of all (y - w)^2 up to a sample (nm^2), for means over any window."""


class Trace:
    """A ring of samples, each with all its signals; one thread writes, others read.

    Attributes
    ----------
    T_ns : int
        Sample period (ns); 0 as long as it is not known.
    unseen : int
        Samples of `displacement` that have not come here, since the first that has.
    run : int
        Counts the runs seen: it changes where time began anew.
    """

    def __init__(self, capacity: int = CAPACITY) -> None:
        self.capacity = capacity
        self._lock = threading.RLock()
        self._rings = {name: np.full(capacity, np.nan) for name in (*SIGNALS, SQUARES)}
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
            self._summed = 0
            self._sum = 0.0

    def put(self, source: str, stamps: np.ndarray, values: Mapping[str, np.ndarray]) -> None:
        """Take samples of one source.

        Parameters
        ----------
        source : str
            One of `SOURCES`.
        stamps : (n,) array of int64
            Their loop time (ns), ascending.
        values : mapping of str to (n,) arrays
            SI.
        """
        if not len(stamps):
            return
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
            for name in SOURCES[source]:
                self._rings[name][slots] = values[name]
            if source == "displacement":
                self.unseen += last + 1 - first - len(k)
                self._rings["eps"][slots] = np.nan
            self._end[source] = max(end, last + 1)
            self._sum_up()

    def fill(self, run: int, start: int, name: str, values: np.ndarray) -> None:
        """Add what was found out about samples that are there.

        Parameters
        ----------
        run : int
            The run that they are of; nothing is added to another.
        start : int
            Number of the first sample.
        name : str
            Of `SIGNALS`.
        values : (n,) array
        """
        with self._lock:
            if run == self.run:
                k = np.arange(start, start + len(values))
                there = k >= self.first
                self._rings[name][k[there] % self.capacity] = values[there]

    def _blank(self, source: str, start: int, end: int) -> None:
        """Say that samples are not known."""
        start = max(start, end - self.capacity)
        slots = np.arange(start, end) % self.capacity
        for name in SOURCES[source]:
            self._rings[name][slots] = np.nan

    def _sum_up(self) -> None:
        """Sum up the squares of the error of samples that have become complete."""
        if any(source not in self._end for source in SOURCES):
            return
        end = self.end
        start = max(self._summed, self.first)
        if end <= start:
            return
        slots = np.arange(start, end) % self.capacity
        error = (self._rings["y"][slots] - self._rings["w"][slots]) * 1e9
        sums = self._sum + np.cumsum(np.square(np.nan_to_num(error)))
        self._rings[SQUARES][slots] = sums
        self._sum, self._summed = float(sums[-1]), end

    @property
    def end(self) -> int:
        """One after the last complete sample; 0 where there is none."""
        if any(source not in self._end for source in SOURCES):
            return 0
        return min(self._end[source] for source in SOURCES)

    @property
    def first(self) -> int:
        """First sample that is still there."""
        if any(source not in self._first for source in SOURCES):
            return 0
        came = max(self._first[source] for source in SOURCES)
        return max(came, max(self._end[source] for source in SOURCES) - self.capacity)

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
            Of `SIGNALS`, or `SQUARES`; all of them where none is named.
        """
        with self._lock:
            start, end = max(start, self.first), min(end, self.end)
            k = np.arange(start, max(end, start))
            slots = k % self.capacity
            wanted = names or (*SIGNALS, SQUARES)
            return {"k": k, **{name: self._rings[name][slots] for name in wanted}}
