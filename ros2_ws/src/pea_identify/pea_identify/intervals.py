"""95 % intervals of what a least squares fit finds."""

from __future__ import annotations

import numpy as np

Z_95 = 1.959964
"""Standard deviations of a 95 % interval."""


def inverse_of_normal(J: np.ndarray) -> np.ndarray:
    """(J^T J)^+ of a Jacobian J (N, n), its columns scaled to one size first.

    Times the variance of one residual it is the covariance of the n unknowns.
    """
    scale = np.maximum(np.linalg.norm(J, axis=0), 1e-300)
    return np.asarray(np.linalg.pinv((J / scale).T @ (J / scale)) / np.outer(scale, scale))
