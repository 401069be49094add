r"""A nominal model of higher order: several modes behind a delay, Section II.

.. math:: V(s) = e^{-s \tau} \sum_i
          \frac{K_i \omega_{n,i}^2}{s^2 + 2 \zeta_i \omega_{n,i} s + \omega_{n,i}^2}

in the form in which `pea identify` writes it. The states are displacement and velocity of each
mode. Discretised exactly, the voltage of a sample acts n + f samples later, n whole,

.. math:: x_{k+1} = \Phi x_k + \Gamma_0 u_{k-n} + \Gamma_1 u_{k-n-1} + \Gamma \varepsilon_k,
          \quad \Gamma_0 = \Gamma((1 - f) T_s), \quad \Gamma_1 = \Gamma - \Gamma_0

where Gamma_0 and Gamma_1 stand for what each of the two voltages does within the interval, and
eps is counted behind the delay. Phi consists of a 2 x 2 block for each mode.

The unknown input ramps, as in `nominal.ramping`. The stationary Kalman filter of
[x, eps, eps'] follows from three noises: that of the sensor, the random walk of eps', and a white
voltage at the input, which stands for errors of the model: the larger it is, the less the filter
trusts a resonance that may lie elsewhere.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from pea_core.nominal import NominalModel, hold, state_space
from pea_core.params import ParameterError, param
from pea_core.units import NM

MODES_MAX = 8
"""Modes that a model may have."""

DELAY_MAX = 60
"""Samples of delay in all that a model may have."""


@dataclass(frozen=True)
class ModalModel:
    """Modes and delay of V; no modes: the one mode that zeta, omega_n and K describe."""

    omega_n: tuple[float, ...] = param(
        (), "rad/s", 1.0, 1e6, help="natural frequencies; none: the one of omega_n", fixed=True
    )
    zeta: tuple[float, ...] = param((), "", 1e-4, 10.0, help="damping ratios", fixed=True)
    K: tuple[float, ...] = param((), "um/V", -1e3, 1e3, help="steady-state gains", fixed=True)
    delay: float = param(0.0, "s", 0.0, 0.01, help="transport delay of V", fixed=True)

    def __post_init__(self) -> None:
        lengths = len(self.omega_n), len(self.zeta), len(self.K)
        if len(set(lengths)) > 1:
            raise ParameterError(
                "omega_n, zeta and K have {}, {} and {} values: "
                "give each once for each mode".format(*lengths)
            )
        if len(self.omega_n) > MODES_MAX:
            raise ParameterError(f"omega_n has {len(self.omega_n)} values: at most {MODES_MAX}")
        if self.omega_n and abs(sum(self.K)) < 1e-6:
            raise ParameterError(f"K = {list(self.K)}: the sum must be at least 1e-06 um/V")

    def or_one(self, nominal: NominalModel) -> ModalModel:
        """Return this model, or where it has no modes that of Eq 2 with its delay."""
        if self.omega_n:
            return self
        return ModalModel((nominal.omega_n,), (nominal.zeta,), (nominal.K,), self.delay)

    @property
    def gain(self) -> float:
        """Steady-state gain (m/V)."""
        return sum(self.K) * 1e-6

    @property
    def size(self) -> np.ndarray:
        """Typical size of each state (2n) under one volt."""
        K = abs(self.gain)
        return np.ravel([(K, K * omega) for omega in self.omega_n])


def varied(model: ModalModel, frequency: Sequence[float], gain: float) -> ModalModel:
    """The model with each frequency and the gain multiplied."""
    omega = tuple(o * f for o, f in zip(model.omega_n, frequency, strict=True))
    return replace(model, omega_n=omega, K=tuple(K * gain for K in model.K))


def continuous(model: ModalModel) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A (2n, 2n), B (2n, 1) and C (1, 2n) in SI, without the delay."""
    from scipy.linalg import block_diag  # slow to import

    modes = [
        state_space(NominalModel(zeta=zeta, omega_n=omega_n, K=K))
        for zeta, omega_n, K in zip(model.zeta, model.omega_n, model.K, strict=True)
    ]
    A = block_diag(*(mode[0] for mode in modes))
    return A, np.vstack([mode[1] for mode in modes]), np.hstack([mode[2] for mode in modes])


class Sampled(NamedTuple):
    """The sampled model.

    F (2n, 2n): Phi.  G, G_0, G_1 (2n): Gamma and its parts.  F_f (2n, 2n), G_f (2n): a step over
    the fraction f alone.  C (2n).  whole: n.  fraction: f.
    """

    F: np.ndarray
    G: np.ndarray
    G_0: np.ndarray
    G_1: np.ndarray
    F_f: np.ndarray
    G_f: np.ndarray
    C: np.ndarray
    whole: int
    fraction: float


def sampled(model: ModalModel, T_s: float) -> Sampled:
    """Discretise exactly.

    Raises
    ------
    ParameterError
        A mode lies beyond half the sample rate.
    """
    modes = zip(model.omega_n, model.zeta, strict=True)
    # what oscillates faster than this cannot be told from what is slower
    beyond = [o for o, z in modes if o * math.sqrt(max(1.0 - z * z, 0.0)) * T_s >= math.pi]
    if beyond:
        highest = max(beyond)
        raise ParameterError(
            f"omega_n = {highest:g}: must be below half the sample rate, {math.pi / T_s:g} rad/s; "
            "leave the mode out"
        )
    A, B, C = continuous(model)
    F, G = hold(A, B, T_s)
    samples = model.delay / T_s
    whole = round(samples) if abs(samples - round(samples)) < 1e-9 else math.floor(samples)
    fraction = max(samples - whole, 0.0)
    if fraction < 1e-9:
        fraction = 0.0
    G_0 = hold(A, B, (1.0 - fraction) * T_s)[1][:, 0]
    F_f, G_f = hold(A, B, fraction * T_s)
    # to the last bit Gamma without a fraction
    G_1 = G[:, 0] - G_0 if fraction else np.zeros(len(A))
    return Sampled(F, G[:, 0], G_0, G_1, F_f, G_f[:, 0], C[0], whole, fraction)


def extended(F: np.ndarray, G: np.ndarray, T_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Step of [x, eps, eps'] (n + 2, n + 2), and what a step of [eps, eps'] adds (n + 2, 2)."""
    n = len(F)
    into = np.vstack([np.column_stack([G, np.zeros(n)]), np.eye(2)])
    step = np.array([[1.0, T_s], [0.0, 1.0]])
    return np.hstack([np.vstack([F, np.zeros((2, n))]), into @ step]), into


@dataclass(frozen=True)
class Noises:
    """What the Kalman filter on modes takes for noise."""

    noise_nm: float = param(0.7, "nm", 1e-3, 1e6, help="sensor noise, rms")
    eps_rate_walk: float = param(
        3000.0, "V/s/sqrt(s)", 1e-3, 1e10, help="how far eps' walks, rms after one second"
    )
    input_noise: float = param(
        0.2, "V", 0.0, 1e4, help="white voltage at the input that stands for errors of the model"
    )


def kalman(model: ModalModel, noises: Noises, T_s: float) -> np.ndarray:
    """Gain L (2n + 2) of the stationary Kalman filter of [x, eps, eps'], in current form.

    Raises
    ------
    ParameterError
        Riccati's equation has no solution, or the error would not die out.
    """
    from scipy.linalg import solve_discrete_are  # slow to import

    of = sampled(model, T_s)
    F, into = extended(of.F, of.G, T_s)
    C = np.append(of.C, [0.0, 0.0])
    walk = np.array([[T_s**3 / 3.0, T_s**2 / 2.0], [T_s**2 / 2.0, T_s]])
    Q = noises.eps_rate_walk**2 * into @ walk @ into.T
    G = np.append(of.G, [0.0, 0.0])
    Q += noises.input_noise**2 * np.outer(G, G)
    size = np.append(model.size, [1.0, model.omega_n[0]])
    R = (noises.noise_nm * NM) ** 2
    failed = "the estimator cannot be designed with these noises: its error would not decay"
    try:
        P = solve_discrete_are(
            (F * size / size[:, None]).T, (C * size / math.sqrt(R))[:, None],
            Q / np.outer(size, size), np.eye(1),
        )  # fmt: skip
    except (np.linalg.LinAlgError, ValueError):
        raise ParameterError(failed) from None
    told = P @ (C * size / math.sqrt(R))
    L = size * told / (float(C * size / math.sqrt(R) @ told) + 1.0) / math.sqrt(R)
    error = F - np.outer(L, C @ F)
    if not np.isfinite(L).all() or np.abs(np.linalg.eigvals(error)).max() >= 1.0:
        raise ParameterError(failed)
    return np.asarray(L)


def optimal_gain(model: ModalModel, effort: float, T_s: float) -> np.ndarray:
    r"""Gain g (2n) of u = -g x that minimises the sum of y^2 + effort (K u)^2 over all samples.

    Raises
    ------
    ParameterError
        Riccati's equation has no solution.
    """
    from scipy.linalg import solve_discrete_are  # slow to import

    of = sampled(model, T_s)
    size = model.size
    F, G = of.F * size / size[:, None], (of.G / size)[:, None]
    C = of.C * size / model.gain
    try:
        X = solve_discrete_are(F, G, np.outer(C, C), np.array([[effort]]))
    except (np.linalg.LinAlgError, ValueError):
        raise ParameterError(
            f"effort = {effort:g}: Riccati's equation has no solution; give another"
        ) from None
    return np.asarray(np.linalg.solve(G.T @ X @ G + effort, G.T @ X @ F)[0] / size)


class Inverse(NamedTuple):
    """1/V along a reference: a_0 w + a_1 w' + a_2 w'' + sum of Re(c_j eta_j).

    eta_j follows w''' by a first-order system with the zero z_j of V for its pole,

    p : exp(z_j T_s) of each zero kept, one of a conjugate pair, as (m, 2) real and imaginary
    part.  c (m, 2): weights, for a step of w''.  backward (m): 1.0 where the zero is unstable, so
    that it is run back from the future.  ahead : samples of the future that it needs.
    """

    a_0: float
    a_1: float
    a_2: float
    p: np.ndarray
    c: np.ndarray
    backward: np.ndarray
    ahead: int


AHEAD_MAX = 30
"""Samples of the future that an inverse may need."""


def inverse(model: ModalModel, T_s: float) -> Inverse:
    r"""Invert V along a reference with exact w, w', w''.

    Partial fractions of 1/V are a polynomial of second order and R_j / (s - z_j) for each zero.
    With

    .. math:: \frac{1}{s - z} = -\frac{1}{z} - \frac{s}{z^2} - \frac{s^2}{z^3}
              + \frac{s^3}{z^3 (s - z)}

    all but the last part joins the polynomial; the last is driven by w''', which is
    (w''_{k+1} - w''_k) / T_s between two samples. An unstable zero is run back from the future,
    until exp(-z t) has fallen to 1e-3 or `AHEAD_MAX` is reached.
    """
    omega, zeta = np.array(model.omega_n), np.array(model.zeta)
    gains = np.array(model.K) * 1e-6 * omega**2
    scale = omega.max()
    # in s / scale, so that the polynomials stay of one size
    squares = [
        np.array([1.0, 2.0 * z * o / scale, (o / scale) ** 2])
        for o, z in zip(omega, zeta, strict=True)
    ]
    num = np.zeros(1)
    den = np.ones(1)
    for i, gain in enumerate(gains):
        part = np.array([gain / scale**2])
        for j, square in enumerate(squares):
            if j != i:
                part = np.polymul(part, square)
        num = np.polyadd(num, part)
        den = np.polymul(den, squares[i])
    keep = np.flatnonzero(np.abs(num) > 1e-12 * np.abs(num).max())
    num = num[keep[0] :]
    zeros = np.roots(num)
    quotient, rest = np.polydiv(den, num)
    a = np.zeros(3)
    order = min(len(quotient), 3)
    a[:order] = quotient[::-1][:order]
    residues = [np.polyval(rest, z) / np.polyval(np.polyder(num), z) for z in zeros]
    p, c, backward, ahead = [], [], [], 0
    for z, R in zip(zeros, residues, strict=True):
        if z.imag < 0.0:
            continue
        twice = 2.0 if z.imag > 0.0 else 1.0
        a += twice * np.array([-(R / z).real, -(R / z**2).real, -(R / z**3).real])
        s = z * scale  # rad/s
        step = np.exp(s * T_s)
        # eta of a step of w'': (e^{z T} - 1) / z / T_s, with the weight R / z^3 in s / scale
        weight = twice * R / z**3 / scale**2 * (step - 1.0) / (s * T_s)
        unstable = s.real > 0.0
        p.append((step.real, step.imag))
        c.append((weight.real, weight.imag))
        backward.append(float(unstable))
        if unstable:
            ahead = max(ahead, min(math.ceil(math.log(1e3) / (s.real * T_s)), AHEAD_MAX))
    return Inverse(
        float(a[0]), float(a[1] / scale), float(a[2] / scale**2),
        np.array(p).reshape(-1, 2), np.array(c).reshape(-1, 2), np.array(backward), ahead,
    )  # fmt: skip
