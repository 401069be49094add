"""V as one second-order system, Eqs 1 and 2."""

import numpy as np

from pea_core.nominal import NominalModel, state_space


def continuous(params: NominalModel) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A (2, 2), B (2, 1) and C (1, 2) from effective voltage (V) to displacement (m).

    The second state is the displacement's derivative (m/s).
    """
    return state_space(params)
