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
    if np.linalg.cond(observability / np.abs(observability).max(axis=0)) > 1e14:
        raise ParameterError("the observer cannot be designed: y does not tell all states")
    polynomial = np.real(np.poly(poles))
    value = np.zeros_like(F)
    for coefficient in polynomial:
        value = value @ F + coefficient * np.eye(n)
    last = np.zeros(n)
    last[-1] = 1.0
    return np.asarray(value @ np.linalg.solve(observability, last))
