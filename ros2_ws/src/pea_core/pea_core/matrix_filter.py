r"""A filter of n signals into n: N taps, matrices, and what undoes it.

.. math:: v_k = \sum_{m=0}^{N-1} A_m\,u_{k-m}, \quad
          u_k = A_0^{-1} \left( v_k - \sum_{m=1}^{N-1} A_m\,u_{k-m} \right)

The functions are compiled into kernels.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

SLOWEST = 0.999
"""Largest pole of an inverse: an error fades in some 1000 samples."""


class Past(NamedTuple):
    """What a filter of N taps and its inverse remember, (N - 1, n) each, the newest first.

    u: what went in.  told: what the inverse gave.
    """

    u: np.ndarray
    told: np.ndarray


def at_rest(A: np.ndarray) -> Past:
    """Their memory before sample 0; taps A (N, n, n)."""
    shape = len(A) - 1, A.shape[1]
    return Past(np.zeros(shape), np.zeros(shape))


def slowest(found: np.ndarray) -> float:
    """Largest |z| of the poles of the inverse of a filter with taps (N, n, n)."""
    n, later = found.shape[1], len(found) - 1
    companion = np.eye(n * later, k=-n)
    companion[:n] = np.hstack([-np.linalg.solve(found[0], own) for own in found[1:]])
    return float(np.abs(np.linalg.eigvals(companion)).max())


def combine(row: np.ndarray, values: Any) -> float:
    """Sum of products in index order."""
    total = 0.0
    for j in range(len(values)):
        total += row[j] * values[j]
    return total


def later(A: np.ndarray, past: np.ndarray, i: int) -> float:
    """What the taps after the first one give output i."""
    total = 0.0
    for m in range(len(past)):
        total += combine(A[m + 1, i], past[m])
    return total


def remember(past: np.ndarray, values: Any) -> None:
    """Put the newest values in front."""
    for m in range(len(past) - 1, 0, -1):
        past[m] = past[m - 1]
    for j in range(len(values)):
        past[0, j] = values[j]
