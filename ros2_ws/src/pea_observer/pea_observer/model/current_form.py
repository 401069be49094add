r"""Gain of an observer in current form.

.. math:: \hat x_k = \bar x_k + L (y_k - C \bar x_k), \quad e_k = (I - L C) \Phi\, e_{k-1}

The error's poles are those of Phi - L (C Phi), placed by Ackermann's formula.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pea_core.params import ParameterError


def current_gain(F: np.ndarray, C: np.ndarray, poles: Sequence[complex]) -> np.ndarray:
    """Gain L (n) that gives the error dynamics `poles`.

    Parameters
    ----------
    F : (n, n) array
        Discrete model.
    C : (1, n) array
        Measured combination of states.
    poles : n complex numbers
        Closed under conjugation; may repeat.

    Raises
    ------
    ParameterError
        The measurement does not tell all states at this sample period.
    """
    n = len(F)
    rows = [C @ np.linalg.matrix_power(F, i + 1) for i in range(n)]
    observability = np.vstack(rows)
    size = np.abs(observability).max(axis=0)
    told = np.isfinite(size).all() and (size > 0.0).all()
    if not told or np.linalg.cond(observability / size) > 1e14:
        raise ParameterError("the observer cannot be designed: y does not tell all states")
    polynomial = np.real(np.poly(poles))
    value = np.zeros_like(F)
    for coefficient in polynomial:
        value = value @ F + coefficient * np.eye(n)
    last = np.zeros(n)
    last[-1] = 1.0
    L = np.asarray(value @ (np.linalg.solve(observability / size, last) / size))
    refuse_unstable(F, C, L)
    return L


def refuse_unstable(F: np.ndarray, C: np.ndarray, L: np.ndarray) -> None:
    """Refuse a gain whose error does not die out, as rounding can make it.

    Raises
    ------
    ParameterError
        An eigenvalue of (I - L C) F is not inside the unit circle.
    """
    if np.isfinite(L).all():
        error = F - np.outer(L, C @ F)
        radius = float(np.abs(np.linalg.eigvals(error)).max())
        if radius < 1.0:
            return
    raise ParameterError(
        "the observer cannot be designed: its error would not die out at this sample period"
    )
