r"""What the observers with a model of several modes share.

The model is that of `pea_core.modal`; the sensor is d_y samples late. So y at sample k measures
the modes at sample k - d_y, on which the voltage of n + f samples before that acted:

.. math:: \bar x_j = \Phi \hat x_{j-1} + \Gamma_0 u_{j-1-n} + \Gamma_1 u_{j-2-n}
          + \Gamma \bar\varepsilon_j, \quad \bar\varepsilon_j = \hat\varepsilon_{j-1}
          + T_s \hat\varepsilon'_{j-1}, \quad j = k - d_y

.. math:: \hat x_j = \bar x_j + L (y_k - C \bar x_j)

where u is the applied voltage; eps and eps' are corrected likewise. The estimate of the present
follows by d_y steps of the model, with the voltages applied since then and the ramp of eps. It is
linear in all of them, so the rows of the product are computed once.

Inputs
    `Measurement` (m, V).
Outputs
    `Estimate` (m, m/s, V): displacement and velocity of the sum of the modes, now.
State
    modes, eps and eps' at sample j after its correction, and the last applied voltages.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pea_core import modal
from pea_core.modal import ModalModel
from pea_core.nominal import NominalModel
from pea_core.params import ParameterError, group, param
from pea_core.signals import Estimate, Measurement


@dataclass(frozen=True)
class ModesParams(NominalModel):
    """Model of several modes; if none are given, the mode of zeta, omega_n and K."""

    model: ModalModel = group(ModalModel)
    sensor_delay_samples: int = param(0, "", 0, 20, help="age of what the sensor tells", fixed=True)

    @property
    def modes(self) -> ModalModel:
        """The model; if no modes are given, the mode of zeta, omega_n and K."""
        return self.model.or_one(self)


class Coefficients(NamedTuple):
    """F (n, n), G, G_0, G_1, C, L (n), l_eps, l_dot: see above, in SI.

    late : n + d_y (samples).  first : n.  ahead : d_y T_s (s).  x1, x2 (n + 2) : rows that give the
    present displacement and velocity from modes, eps and eps'.  u1, u2 (d_y + 1) : rows for the
    voltages that acted since sample j, the newest first.
    """

    F: np.ndarray
    G: np.ndarray
    G_0: np.ndarray
    G_1: np.ndarray
    C: np.ndarray
    L: np.ndarray
    l_eps: float
    l_dot: float
    late: int
    first: int
    ahead: float
    T_s: float
    x1: np.ndarray
    x2: np.ndarray
    u1: np.ndarray
    u2: np.ndarray


class State(NamedTuple):
    """x (n), eps (V), eps_dot (V/s) after the last correction.

    u (late + 1): voltages applied before that of the last interval, the newest first (V).
    """

    x: np.ndarray
    eps: float
    eps_dot: float
    u: np.ndarray


def designed(params: ModesParams, L: np.ndarray, T_s: float) -> Coefficients:
    """Discretise the model; compute the rows of the present estimate.

    Parameters
    ----------
    params : ModesParams
    L : (n + 2,) array
        Gain of [x, eps, eps'].
    T_s : float
        Sample period (s).
    """
    of = modal.sampled(params.modes, T_s)
    F, _ = modal.extended(of.F, of.G, T_s)
    n, late = len(of.F), params.sensor_delay_samples
    rows = np.zeros((2, n + 2))
    rows[0, :n], rows[1, 1:n:2] = of.C, 1.0
    acted = np.zeros((2, late + 1))
    for j in range(late):
        acted[:, j] += rows[:, :n] @ of.G_0
        acted[:, j + 1] += rows[:, :n] @ of.G_1
        rows = rows @ F
    return Coefficients(
        F=of.F, G=of.G, G_0=of.G_0, G_1=of.G_1, C=of.C, L=L[:n].copy(),
        l_eps=float(L[n]), l_dot=float(L[n + 1]), late=late + of.whole, first=of.whole,
        ahead=late * T_s, T_s=T_s, x1=rows[0].copy(), x2=rows[1].copy(),
        u1=acted[0].copy(), u2=acted[1].copy(),
    )  # fmt: skip


def placed(model: ModalModel, omega_o: float, T_s: float) -> np.ndarray:
    """Gain L (n + 2) that puts the error's poles where a Butterworth filter of omega_o has them.

    Raises
    ------
    ParameterError
        omega_o lies beyond half the sample rate, or rounding leaves an error that does not decay.
    """
    from scipy.signal import place_poles  # slow to import

    if omega_o * T_s >= np.pi:
        raise ParameterError(
            f"omega_o = {omega_o:g}: must be below half the sample rate, {np.pi / T_s:g} rad/s"
        )
    of = modal.sampled(model, T_s)
    F, _ = modal.extended(of.F, of.G, T_s)
    n = len(F)
    size = np.append(model.size, [1.0, model.omega_n[0]])
    H = (np.append(of.C, [0.0, 0.0]) @ F * size)[:, None]
    F_s = F * size / size[:, None]
    angles = np.pi * (0.5 + (2.0 * np.arange(n // 2) + 1.0) / (2.0 * n))  # n is even
    half = np.exp(omega_o * T_s * np.exp(1j * angles))
    poles = np.append(half, half.conj())
    try:
        L = size * place_poles(F_s.T, H / np.abs(H).max(), poles).gain_matrix[0] / np.abs(H).max()
        radius = float(np.abs(np.linalg.eigvals(F - np.outer(L, H[:, 0] / size))).max())
    except (ValueError, np.linalg.LinAlgError):
        radius = np.inf
    if not radius < 1.0:
        raise ParameterError(
            f"omega_o = {omega_o:g}: the observer cannot be designed, its error would not decay "
            "at this sample period"
        )
    return np.asarray(L)


def begun(c: Coefficients) -> State:
    """At rest, no unknown input."""
    return State(np.zeros(c.C.size), 0.0, 0.0, np.zeros(c.late + 1))


def applied(s: State, measured: Measurement, back: int) -> float:
    """Voltage applied `back` samples before that of the last interval (V)."""
    return measured.u_applied if back == 0 else float(s.u[back - 1])


def stepped(c: Coefficients, s: State, measured: Measurement, i: int) -> float:
    """State i before the correction."""
    first = i - i % 2  # Phi has a block for each mode
    moved = c.F[i, first] * s.x[first] + c.F[i, first + 1] * s.x[first + 1]
    moved += c.G_0[i] * applied(s, measured, c.late) + c.G_1[i] * applied(s, measured, c.late + 1)
    return float(moved + c.G[i] * (s.eps + c.T_s * s.eps_dot))


def innovation(c: Coefficients, s: State, measured: Measurement) -> float:
    """y minus its prediction (m)."""
    r = measured.y
    for i in range(c.C.size):
        r -= c.C[i] * stepped(c, s, measured, i)
    return r


def estimated(c: Coefficients, s: State, measured: Measurement) -> Estimate:
    """Predict, correct, and predict to the present."""
    r, n = innovation(c, s, measured), c.C.size
    eps, eps_dot = s.eps + c.T_s * s.eps_dot + c.l_eps * r, s.eps_dot + c.l_dot * r
    x1 = c.x1[n] * eps + c.x1[n + 1] * eps_dot
    x2 = c.x2[n] * eps + c.x2[n + 1] * eps_dot
    for i in range(n):
        x = stepped(c, s, measured, i) + c.L[i] * r
        x1 += c.x1[i] * x
        x2 += c.x2[i] * x
    for j in range(c.u1.size):
        u = applied(s, measured, c.first + j)
        x1 += c.u1[j] * u
        x2 += c.u2[j] * u
    return Estimate(float(x1), float(x2), float(eps + c.ahead * eps_dot))


def kept(c: Coefficients, s: State, measured: Measurement) -> State:
    """Keep the corrected estimate and the voltage."""
    r = innovation(c, s, measured)
    eps = s.eps + c.T_s * s.eps_dot + c.l_eps * r
    for i in range(0, c.C.size, 2):
        x1 = stepped(c, s, measured, i) + c.L[i] * r
        x2 = stepped(c, s, measured, i + 1) + c.L[i + 1] * r
        s.x[i], s.x[i + 1] = x1, x2
    eps_dot = s.eps_dot + c.l_dot * r
    for j in range(c.late, 0, -1):
        s.u[j] = s.u[j - 1]
    s.u[0] = measured.u_applied
    return State(s.x, eps, eps_dot, s.u)
