"""The nominal model, Eq 2: the one piece of physics that plant, observer and controller share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pea_core.params import param


@dataclass(frozen=True)
class NominalModel:
    r"""Second-order model of the actuator, Eqs 1 and 2.

    .. math:: \dot X = A X + B (u + \varepsilon), \quad y = C X

    with A21 = -omega_n^2, A22 = -2 zeta omega_n, B2 = K omega_n^2.
    """

    zeta: float = param(0.82, "", 1e-4, 10.0, help="damping ratio", common=True)
    omega_n: float = param(5450.0, "rad/s", 1.0, 1e6, help="natural frequency", common=True)
    K: float = param(0.142, "um/V", 1e-6, 1e3, help="steady-state gain", common=True)

    @property
    def A21(self) -> float:
        """-omega_n^2 (1/s^2)."""
        return -self.omega_n * self.omega_n

    @property
    def A22(self) -> float:
        """-2 zeta omega_n (1/s)."""
        return -2.0 * self.zeta * self.omega_n

    @property
    def B2(self) -> float:
        """K omega_n^2 (m/(V s^2))."""
        return self.K * 1e-6 * self.omega_n * self.omega_n


def state_space(model: NominalModel) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A (2, 2), B (2, 1) and C (1, 2) of Eq 2 in SI units."""
    A = np.array([[0.0, 1.0], [model.A21, model.A22]])
    B = np.array([[0.0], [model.B2]])
    return A, B, np.array([[1.0, 0.0]])


def hold(A: np.ndarray, B: np.ndarray, T_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Exact zero-order-hold discretisation of x' = A x + B u over T_s (s).

    Parameters
    ----------
    A : (n, n) array
    B : (n, r) array
    T_s : float
        Sample period (s).

    Returns
    -------
    (n, n) and (n, r) arrays
        x(k+1) = A_d x(k) + B_d u(k) for u held over the interval.
    """
    from scipy.linalg import expm  # slow to import

    n, r = B.shape
    block = np.zeros((n + r, n + r))
    block[:n, :n] = A
    block[:n, n:] = B
    step = expm(block * T_s)
    return step[:n, :n], step[:n, n:]


def ramping(F: np.ndarray, G: np.ndarray, T_s: float) -> tuple[np.ndarray, np.ndarray]:
    r"""The sampled model with an unknown input that ramps: states [x1, x2, eps, eps'].

    .. math:: \varepsilon_k = \varepsilon_{k-1} + T_s \varepsilon'_{k-1}, \quad
              x_k = \Phi x_{k-1} + \Gamma (u_{k-1} + \varepsilon_k)

    Parameters
    ----------
    F : (2, 2) array
        Phi, from `hold`.
    G : (2, 1) array
        Gamma, from `hold`.
    T_s : float
        Sample period (s).

    Returns
    -------
    (4, 4) array
        From the states of one sample to those of the next, without u.
    (4, 2) array
        What a step of [eps, eps'] at a sample adds to the states there.
    """
    into = np.vstack([np.hstack([G, np.zeros((2, 1))]), np.eye(2)])
    step = np.array([[1.0, T_s], [0.0, 1.0]])
    return np.hstack([np.vstack([F, np.zeros((2, 2))]), into @ step]), into
