"""Fewer samples to look at, so that no spike disappears (min-max decimation)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

FULL = 16
"""Samples in a row up to which all are kept."""


def extremes(signals: Sequence[np.ndarray], size: int, first: int = 0) -> np.ndarray:
    """Samples at which one of the signals is smallest or largest among `size` in a row.

    What is not known (NaN) is neither; a row of nothing else keeps its first sample.

    Parameters
    ----------
    signals : sequence of (n,) arrays
        In the same order of samples.
    size : int
        Samples in a row that are looked at together, 1 or more.
    first : int
        Number of the first sample: rows begin at multiples of `size`, so that a sample that was
        kept stays kept when more come.

    Returns
    -------
    (m,) array of int
        Their places, ascending: at most 2 `size`-th parts of each signal's.
    """
    n = len(signals[0])
    if size <= FULL:
        return np.arange(n)
    head = min(-first % size, n)
    whole = (n - head) // size
    tail = head + whole * size
    found = []
    for signal in signals:
        low = high = np.ascontiguousarray(signal)
        if np.isnan(low).any():
            low, high = (np.where(np.isnan(signal), end, signal) for end in (np.inf, -np.inf))
        for side, at in ((low, np.argmin), (high, np.argmax)):
            rows = side[head:tail].reshape(whole, size)
            found += [head + size * np.arange(whole) + at(rows, 1)] if whole else []
            for start, end in ((0, head), (tail, n)):
                if start < end:
                    found.append(np.array([start + at(side[start:end])]))
    return np.unique(np.concatenate(found)) if found else np.arange(0)
