"""V as one second-order system, Eqs 1 and 2, with the plant's own zeta, omega_n and K."""

from dataclasses import dataclass

import numpy as np

from pea_core.nominal import NominalModel, state_space
from pea_plant.model.vibration.late import Delayed


@dataclass(frozen=True)
class Params(Delayed):
    """No parameters besides the plant's and the delay."""


def continuous(nominal: NominalModel, params: Params) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A (2, 2), B (2, 1) and C (1, 2); the second state is the velocity (m/s)."""
    return state_space(nominal)


def initial(params: Params, x1: float, x2: float) -> np.ndarray:
    """States (2) with displacement x1 (m) and velocity x2 (m/s)."""
    return np.array([x1, x2])
