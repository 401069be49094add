"""A recording in memory: the samples of the loop by stamp, and what else the bag says."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from pea_core.axes import POINT
from pea_core.printable import printable
from pea_wire.events import ParameterEvent


class BagError(Exception):
    """A recording that cannot be read; one line that says why.

    Text from a damaged file is made `printable`.
    """

    def __init__(self, text: object) -> None:
        super().__init__(printable(text))


@dataclass(frozen=True)
class Recording:
    """What a recording holds.

    Attributes
    ----------
    axes : tuple of str
        Names of the axes.
    samples : (n,) array of `SAMPLE`, or (n, axes)
        The complete samples, by stamp; a NaN where a message leaves a field out.
    stamps : (n,) array of int64
        Their stamps (ns).
    T_ns : int
        Sample period (ns): the commonest distance of stamps; 0 where there is one stamp only.
    counts : dict of str to int
        Messages of every topic.
    gaps : dict of str to int
        For each topic of the loop, stamps missing between its first and its last.
    repeats : dict of str to int
        For each topic of the loop, stamps that came again; the first of each counts.
    spans : dict of str to (int, int)
        For each topic of the loop, its first and last stamp (ns).
    after : (m, axes x 3) array
        Reference (m, m/s, m/s^2) of the samples that follow the last complete one.
    events : list of ParameterEvent
        Changes of parameters, by stamp.
    metadata : dict of str to dict
        Records of names and texts, by name.
    damage : str
        What could not be read, empty where all could.
    signal : (n,) array or None
        The sample signal at each sample, NaN where none is recorded; None of a recording without.
    """

    axes: tuple[str, ...]
    samples: np.ndarray
    stamps: np.ndarray
    T_ns: int
    counts: dict[str, int]
    gaps: dict[str, int]
    repeats: dict[str, int]
    spans: dict[str, tuple[int, int]]
    after: np.ndarray
    events: list[ParameterEvent]
    metadata: dict[str, dict[str, str]]
    damage: str
    signal: np.ndarray | None = None

    @property
    def first(self) -> int:
        """Stamp of the first complete sample (ns)."""
        return int(self.stamps[0])

    @property
    def last(self) -> int:
        """Stamp of the last complete sample (ns)."""
        return int(self.stamps[-1])

    def of(self, axis: str) -> Recording:
        """One axis of it."""
        if len(self.axes) == 1:
            return self
        i = self.axes.index(axis)
        samples = np.ascontiguousarray(self.samples[:, i])
        after = self.after[:, POINT * i : POINT * (i + 1)]
        events = [event.of(axis, self.axes) for event in self.events]
        events = [event for event in events if event.new or event.changed]
        return dataclasses.replace(self, axes=(axis,), samples=samples, after=after, events=events)
