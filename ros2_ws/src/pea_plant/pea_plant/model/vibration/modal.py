r"""V as a linear combination of second-order systems (Section II), one for each mode.

.. math:: V(s) = \sum_i \frac{K_i \omega_{n,i}^2}{s^2 + 2 \zeta_i \omega_{n,i} s + \omega_{n,i}^2}

The plant's own zeta, omega_n and K do not enter: they stay what the nominal model, and so
the lumped unknown input, is stated with.
"""

from dataclasses import dataclass

import numpy as np

from pea_core.nominal import NominalModel, state_space
from pea_core.params import ParameterError, param
from pea_plant.model.vibration.late import Delayed


@dataclass(frozen=True)
class Params(Delayed):
    """Modes, one place in each list a mode; the defaults add a weak second one."""

    omega_n: tuple[float, ...] = param(
        (5450.0, 24000.0), "rad/s", 1.0, 1e6, help="natural frequencies", fixed=True
    )
    zeta: tuple[float, ...] = param((0.82, 0.02), "", 1e-4, 10.0, help="damping ratios", fixed=True)
    K: tuple[float, ...] = param(
        (0.14, 0.002), "um/V", -1e3, 1e3, help="steady-state gains", fixed=True
    )

    def __post_init__(self) -> None:
        lengths = len(self.omega_n), len(self.zeta), len(self.K)
        if not self.omega_n or len(set(lengths)) > 1:
            raise ParameterError(
                "omega_n, zeta and K have {}, {} and {} values: "
                "give each once for each mode".format(*lengths)
            )
        if sum(self.K) < 1e-6:
            raise ParameterError(f"K = {list(self.K)}: the sum must be at least 1e-06 um/V")


def continuous(nominal: NominalModel, params: Params) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A (2n, 2n), B (2n, 1) and C (1, 2n) of n modes, displacement and velocity of each."""
    from scipy.linalg import block_diag  # slow to import

    modes = [
        state_space(NominalModel(zeta=zeta, omega_n=omega_n, K=K))
        for zeta, omega_n, K in zip(params.zeta, params.omega_n, params.K, strict=True)
    ]
    A = block_diag(*(mode[0] for mode in modes))
    return A, np.vstack([mode[1] for mode in modes]), np.hstack([mode[2] for mode in modes])


def initial(params: Params, x1: float, x2: float) -> np.ndarray:
    """States (2n) with displacement x1 (m) and velocity x2 (m/s), shared as a static load does."""
    shares = np.array(params.K) / sum(params.K)
    return np.outer(shares, [x1, x2]).ravel()
