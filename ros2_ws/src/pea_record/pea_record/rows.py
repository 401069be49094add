"""Samples of a loop in this process, recorded as the messages that nodes would have sent."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from pea_core.config import AXIS
from pea_core.loop import CHUNK, PREVIEW_MAX, Loop
from pea_record.bag import BagWriter
from pea_record.nowhere import Nowhere
from pea_wire import convert, diagnostics, scanning
from pea_wire.topics import DIAGNOSTICS, EVENTS, REFERENCE, SAMPLED, SIGNAL

Events = Callable[[int, int], np.ndarray]

NOTHING = np.empty((0, 0))
NO_SIGNAL = np.empty(0)


def ahead(loop: Loop) -> np.ndarray:
    """The reference of the samples after the last one: what a preview at the end had seen.

    Parameters
    ----------
    loop : Loop
        At its end.

    Returns
    -------
    (n, axes x 3) array
        w (m), w_dot (m/s), w_ddot (m/s^2) of the next samples.
    """
    points = [loop.coming(k) for k in range(loop.k, loop.k + PREVIEW_MAX + 1)]
    return np.array(points).reshape(len(points), -1)


def record(
    bag: BagWriter | Nowhere,
    k: int,
    T_ns: int,
    rows: np.ndarray,
    after: np.ndarray = NOTHING,
    axes: tuple[str, ...] = (AXIS,),
    scanned: Events | None = None,
    signal: np.ndarray = NO_SIGNAL,
) -> None:
    """Record samples k, k+1, ...

    Parameters
    ----------
    bag : BagWriter or Nowhere
    k : int
        Number of the first sample.
    T_ns : int
        Sample period (ns).
    rows : (n,) or (n, axes) array of `SAMPLE`
    after : (m, axes x 3) array
        Reference of the samples after them, where no more will be recorded; from `ahead`.
    axes : tuple of str
        Names of the axes.
    scanned : callable, optional
        Events of the scan that begin at samples first to last - 1.
    signal : (n,) array
        The sample signal at each, NaN where it is not known; empty where nothing tells it.
    """
    if not len(rows) or isinstance(bag, Nowhere):
        return
    stamps = (k + np.arange(len(rows), dtype=np.int64)) * T_ns
    forms = convert.forms(axes)
    points = forms.points(rows)
    points = np.concatenate([points, after]) if len(after) else points
    note(bag, k, k + len(rows), T_ns, scanned)
    if (told := np.isfinite(signal)).any():
        detected = convert.DETECTED.encode_many(stamps[told], signal[told])
        bag.write_many(SIGNAL, stamps[told], detected)
    for first in range(0, len(rows), CHUNK):  # a loop in wall time may hand over seconds at once
        last = first + CHUNK if first + CHUNK < len(rows) else len(points)
        chunk = forms.reference.encode(int(stamps[first]), T_ns, points[first:last])
        bag.write(REFERENCE, int(stamps[first]), chunk)
    for topic in SAMPLED:
        bag.write_many(topic, stamps, forms.messages(topic, stamps, rows))
    bag.keep()


def note(
    bag: BagWriter | Nowhere, first: int, last: int, T_ns: int, scanned: Events | None
) -> None:
    """Record the events of a scan that begin at samples first to last - 1."""
    if scanned is not None and len(found := scanned(first, last)):
        bag.write(EVENTS, int(found["k"][0]) * T_ns, scanning.encode(found, T_ns))


class Trip:
    """Records that the safety gate of a simulated plant has tripped.

    Parameters
    ----------
    bag : BagWriter or Nowhere
    plant : Simulated
    """

    def __init__(self, bag: BagWriter | Nowhere, plant: Any) -> None:
        self.bag = bag
        self.plant = plant
        self.told = False

    def look(self) -> None:
        """Record the trip, where there is one that is not recorded yet."""
        if not self.told and (found := self.plant.transition) is not None:
            self.told = True
            self.bag.write(DIAGNOSTICS, found.stamp, diagnostics.transition(*found))
