"""Samples from the topics of the loop, put together by stamp."""

from __future__ import annotations

from collections import defaultdict

import numpy as np

from pea_core.axes import shape
from pea_core.signals import SAMPLE, columns_of
from pea_record.large import empty, pieces, same
from pea_wire import convert
from pea_wire.topics import DISPLACEMENT, LOOP, Topic

FIELDS = ("position", "velocity", "effort")
"""Fields of a message, each a column of every axis."""


def rising(stamps: np.ndarray) -> bool:
    """Whether each stamp is later than the one before."""
    return all((np.diff(stamps[part]) > 0).all() for part in pieces(len(stamps), stamps, before=1))


def commonest_period(tracks: list[np.ndarray]) -> int:
    """The commonest distance of stamps (ns), the smallest where several are."""
    found: dict[int, int] = defaultdict(int)
    for track in tracks:
        for part in pieces(len(track), track, before=1):
            every = np.diff(track[part])
            if len(every) and every.min() == every.max():
                found[int(every[0])] += len(every)
            else:
                for step, count in zip(*np.unique(every, return_counts=True)):
                    found[int(step)] += int(count)
    return min(found, key=lambda step: (-found[step], step)) if found else 0


def missing_in(stamps: np.ndarray, T_ns: int) -> int:
    """How many stamps are missing between the first and the last, T_ns apart."""
    if not T_ns:
        return 0
    parts = pieces(len(stamps), stamps, before=1)
    return sum(int((np.diff(stamps[part]) // T_ns - 1).clip(0).sum()) for part in parts)


def following(known: np.ndarray, points: np.ndarray, last: int, T_ns: int) -> np.ndarray:
    """Points without a gap after the stamp `last`."""
    first = int(np.searchsorted(known, last, side="right"))
    expected = last + T_ns * np.arange(1, len(known) - first + 1)
    right = known[first:] == expected
    count = len(right) if right.all() else int(np.argmin(right))
    following: np.ndarray = points[first : first + count]
    return following


def assemble(
    tracks: dict[Topic, tuple[np.ndarray, np.ndarray]], axes: int
) -> tuple[np.ndarray, np.ndarray]:
    """Stamps and samples that every topic of the loop knows."""
    common = tracks[DISPLACEMENT][0]
    for stamps, _ in tracks.values():
        if not same(stamps[: len(common)], common):
            common = np.intersect1d(common, stamps, assume_unique=True)
    samples = empty(shape(len(common), axes), SAMPLE)
    for topic in LOOP:
        stamps, values = tracks[topic]
        alike = same(stamps[: len(common)], common)
        for part in pieces(len(common), common, stamps, values, samples):
            rows = values[part if alike else np.searchsorted(stamps, common[part])].T
            for column in columns_of(topic.relative):
                own = rows[convert.place(column) :: len(FIELDS)]
                samples[column.name][part] = own[0] if axes == 1 else own.T
    return common, samples
