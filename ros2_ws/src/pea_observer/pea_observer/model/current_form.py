r"""Gain of an observer in current form.

.. math:: \hat x_k = \bar x_k + L (y_k - C \bar x_k), \quad e_k = (I - L C) \Phi\, e_{k-1}

The error's poles are those of Phi - L (C Phi): placed by Ackermann's formula, or left to the
stationary Kalman filter.
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
    return place(F, C @ F, poles)


def place(F: np.ndarray, H: np.ndarray, poles: Sequence[complex]) -> np.ndarray:
    """Gain L (n) that gives F - L H the eigenvalues `poles`; errors as `current_gain`."""
    n = len(F)
    value = np.zeros_like(F)
    for coefficient in np.real(np.poly(poles)):
        value = value @ F + coefficient * np.eye(n)
    L = np.asarray(value @ direction(F, H))
    refuse_unstable(F, H, L)
    return L


def direction(F: np.ndarray, H: np.ndarray) -> np.ndarray:
    r"""Ackermann's vector: the last column of the inverse of [H; H F; ...; H F^{n-1}].

    Raises
    ------
    ParameterError
        H does not tell all states.
    """
    observability = np.vstack([H @ np.linalg.matrix_power(F, i) for i in range(len(F))])
    size = np.abs(observability).max(axis=0)
    told = np.isfinite(size).all() and (size > 0.0).all()
    if not told or np.linalg.cond(observability / size) > 1e14:
        raise ParameterError("the observer cannot be designed: y does not determine all states")
    last = np.zeros(len(F))
    last[-1] = 1.0
    return np.asarray(np.linalg.solve(observability / size, last) / size)


def kalman_gain(
    F: np.ndarray, C: np.ndarray, Q: np.ndarray, R: float, scale: np.ndarray
) -> np.ndarray:
    r"""Gain L (n) of the stationary Kalman filter.

    .. math:: P = \Phi P \Phi^T - \Phi P C^T (C P C^T + R)^{-1} C P \Phi^T + Q, \quad
              L = P C^T (C P C^T + R)^{-1}

    Parameters
    ----------
    F : (n, n) array
        Discrete model.
    C : (1, n) array
        Measured combination of states.
    Q : (n, n) array
        Covariance of what drives the states over one sample.
    R : float
        Variance of the measurement's noise.
    scale : (n,) array
        Typical size of each state, so that the equation is solved in numbers of one size.

    Raises
    ------
    ParameterError
        The equation has no solution, or the error would not die out.
    """
    from scipy.linalg import solve_discrete_are  # slow to import

    F_s = F * scale / scale[:, None]
    C_s = C * scale / np.sqrt(R)
    Q_s = Q / np.outer(scale, scale)
    try:
        P = solve_discrete_are(F_s.T, C_s.T, Q_s, np.eye(1))
    except (np.linalg.LinAlgError, ValueError):
        raise ParameterError(
            "the observer cannot be designed: Riccati's equation has no solution for these noises"
        ) from None
    told = P @ C_s[0]
    L = np.asarray(scale * told / (float(C_s[0] @ told) + 1.0) / np.sqrt(R))
    refuse_unstable(F, C @ F, L)
    return L


def refuse_unstable(F: np.ndarray, H: np.ndarray, L: np.ndarray) -> None:
    """Refuse a gain whose error does not die out, as rounding can make it.

    Raises
    ------
    ParameterError
        An eigenvalue of F - L H is not inside the unit circle.
    """
    if np.isfinite(L).all():
        radius = float(np.abs(np.linalg.eigvals(F - np.outer(L, H))).max())
        if radius < 1.0:
            return
    raise ParameterError(
        "the observer cannot be designed: its error would not decay at this sample period"
    )
