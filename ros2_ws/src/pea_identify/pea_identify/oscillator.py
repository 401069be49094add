r"""A mass on a spring and a Bouc-Wen element, driven by a force: simulated and identified.

.. math:: m \ddot y + c \dot y + k y + z = u, \quad
          \dot z = \alpha \dot y - \beta (\gamma |\dot y| |z|^{\nu - 1} z + \delta \dot y |z|^\nu)

Here hysteresis lies inside the resonance, where no static model in front of V can stand for it.
Only the products beta gamma and beta delta act, so beta is given and gamma and delta are fitted.
The equations are solved by the fourth-order Runge-Kutta rule at `STEPS` steps a sample. The
parameters minimise the error of the simulation, from rest, over the whole record; they begin at
the linear oscillator that is closest to the data.

Source: J. P. Noel and J. Schoukens, Hysteretic benchmark with a dynamic nonlinearity, Workshop
on Nonlinear System Identification Benchmarks, 2016.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np

from pea_core.params import ParameterError
from pea_engine.kernel import Kernel, compile_kernel
from pea_identify.intervals import Z_95, inverse_of_normal
from pea_identify.modes import HOLDS

STEPS = 20
"""Runge-Kutta steps a sample."""

COARSE = 4
"""Steps a sample while first values are compared."""

FREE = ("m", "c", "k", "alpha", "gamma", "delta")
"""Parameters that are fitted; nu besides where it is asked for."""


class Oscillator(NamedTuple):
    """m (kg), c (N s/m), k (N/m); alpha (N/m), beta (1/m at nu = 1), gamma, delta, nu of z (N)."""

    m: float
    c: float
    k: float
    alpha: float
    beta: float
    gamma: float
    delta: float
    nu: float = 1.0


@dataclass(frozen=True)
class OscillatorFit:
    """A fitted oscillator.

    Attributes
    ----------
    values : Oscillator
    half_width_95 : dict of str to float
        Half width of the 95 % interval of each fitted parameter.
    error : float
        Rms of what the simulation leaves of y (m).
    sentences : tuple of str
        What the data do not determine.
    """

    values: Oscillator
    half_width_95: dict[str, float]
    error: float
    sentences: tuple[str, ...]


def simulate(
    p: Oscillator, u: np.ndarray, T_s: float, hold: str = "band_limited", steps: int = STEPS
) -> np.ndarray:
    """Displacement (N,) in m along a force (N,) in N, from rest.

    Parameters
    ----------
    p : Oscillator
    u : (N,) array
        Whole periods where `hold` is ``band_limited``.
    T_s : float
        Sample period (s).
    hold : str
        What lies between the samples of u: ``zero_order`` or ``band_limited``.
    steps : int
        Steps a sample.
    """
    y = np.empty(len(u))
    _kernel()(between(u, hold, steps), steps, T_s / steps, tuple(map(float, p)), y)
    return y


def between(u: np.ndarray, hold: str, steps: int) -> np.ndarray:
    """u at the beginning and in the middle of each step.

    Raises
    ------
    ParameterError
        Unknown hold.
    """
    if hold not in HOLDS:
        raise ParameterError(f"hold {hold!r}: must be one of {', '.join(HOLDS)}")
    fine = 2 * steps
    if hold == "zero_order":
        return np.repeat(np.asarray(u, dtype=float), fine)
    spectrum = np.fft.rfft(u)
    return np.asarray(np.fft.irfft(spectrum, len(u) * fine) * fine)


@cache
def _kernel() -> Kernel:
    return compile_kernel(_integrate)


def _integrate(
    u: np.ndarray,
    steps: int,
    h: float,
    p: tuple[float, float, float, float, float, float, float, float],
    out: np.ndarray,
) -> None:
    """Runge-Kutta: u (2 steps N,) at each half step of h (s); y at the samples into out (N,)."""
    m, c, k, alpha, beta, gamma, delta, nu = p
    y, v, z = 0.0, 0.0, 0.0
    last = len(u) - 1
    for i in range(len(out)):
        out[i] = y
        for j in range(steps):
            at = 2 * (i * steps + j)
            f_y, f_v, f_z = 0.0, 0.0, 0.0
            s_y, s_v, s_z = 0.0, 0.0, 0.0
            for stage in range(4):
                shift = 0.0 if stage == 0 else (h if stage == 3 else 0.5 * h)
                a, b, q = y + shift * f_y, v + shift * f_v, z + shift * f_z
                force = u[min(at + (stage + 1) // 2, last)]
                size = abs(q)
                power = 1.0 if nu == 1.0 else (size ** (nu - 1.0) if size > 0.0 else 0.0)
                f_y = b
                f_v = (force - c * b - k * a - q) / m
                f_z = alpha * b - beta * power * (gamma * abs(b) * q + delta * b * size)
                weight = 2.0 if 0 < stage < 3 else 1.0
                s_y += weight * f_y
                s_v += weight * f_v
                s_z += weight * f_z
            y += h / 6.0 * s_y
            v += h / 6.0 * s_v
            z += h / 6.0 * s_z


def linear(u: np.ndarray, y: np.ndarray, T_s: float) -> tuple[float, float, float]:
    """m, c and k of the linear oscillator that is closest to a record, by its spectra.

    Raises
    ------
    ParameterError
        The record shows no oscillator.
    """
    U, Y = np.fft.rfft(u), np.fft.rfft(y)
    omega = 2.0 * math.pi * np.arange(len(U)) / (len(u) * T_s)
    use = np.abs(U) > 1e-3 * np.abs(U[1:]).max()
    use[0] = False
    U, Y, omega = U[use], Y[use], omega[use]
    A = np.column_stack([-(omega**2) * Y, 1j * omega * Y, Y])
    A, b = np.concatenate([A.real, A.imag]), np.concatenate([U.real, U.imag])
    scale = np.linalg.norm(A, axis=0)
    if len(omega) < 8 or not scale.all():
        raise ParameterError(
            f"{len(omega)} frequencies are excited: an oscillator needs a multisine over its "
            "resonance"
        )
    m, c, k = np.linalg.lstsq(A / scale, b, rcond=None)[0] / scale
    if not (m > 0.0 and k > 0.0):
        raise ParameterError(
            f"the record shows no oscillator (m = {m:.3g} kg, k = {k:.3g} N/m): is u a force in N "
            "and y a displacement in m?"
        )
    return float(m), max(float(c), 1e-3 * math.sqrt(m * k)), float(k)


def first_guesses(
    m: float, c: float, k: float, reach: float, free_nu: bool
) -> Iterator[np.ndarray]:
    """Values that `fit` starts from: the linear oscillator, part of its stiffness given to z.

    `reach` is the largest displacement (m).
    """
    for share, bend, side in itertools.product((0.3, 0.5, 0.7), (0.3, 1.0), (-1.0, 0.0, 1.0)):
        size = bend / reach
        x = [math.log(m), math.log(0.5 * c), math.log(k * (1.0 - share)), math.log(k * share)]
        yield np.array([*x, size, side * size, *([1.0] if free_nu else [])])


def half_widths(jacobian: np.ndarray, rms: float, samples: int) -> np.ndarray:
    """Half widths of the 95 % intervals of a fit's unknowns, from what it leaves (rms)."""
    variance = rms**2 * samples / (samples - jacobian.shape[1])
    covariance = inverse_of_normal(jacobian) * variance
    return np.asarray(Z_95 * np.sqrt(np.diag(covariance)))


def fit(
    u: np.ndarray,
    y: np.ndarray,
    T_s: float,
    beta: float = 1.0,
    hold: str = "band_limited",
    first: int = 0,
    free_nu: bool = False,
) -> OscillatorFit:
    """Identify the oscillator from a force (N,) in N and a displacement (N,) in m.

    Parameters
    ----------
    u, y : (N,) arrays
        From rest; whole periods where `hold` is ``band_limited``.
    T_s : float
        Sample period (s).
    beta : float
        What gamma and delta are stated for.
    hold : str
        As in `simulate`.
    first : int
        First sample that counts: those before carry a state that is not known.
    free_nu : bool
        Fit nu; it is 1 otherwise.

    Raises
    ------
    ParameterError
        The data show no oscillator, or no parameters simulate it.
    """
    from scipy.optimize import least_squares

    u, y = np.asarray(u, dtype=float).ravel(), np.asarray(y, dtype=float).ravel()
    if len(u) != len(y):
        raise ParameterError(f"u has {len(u)} samples and y {len(y)}: give as many")
    m, c, k = linear(u[first:], y[first:], T_s)
    reach, stroke = float(np.abs(y[first:]).max()), float(y[first:].std())
    forces = {steps: between(u, hold, steps) for steps in (COARSE, STEPS)}
    model = np.empty(len(u))

    def values(x: np.ndarray) -> Oscillator:
        m, c, k, alpha = np.exp(x[:4]).tolist()
        nu = float(x[6]) if free_nu else 1.0
        return Oscillator(m, c, k, alpha, beta, float(x[4]) / beta, float(x[5]) / beta, nu)

    def left(x: np.ndarray, steps: int = STEPS) -> np.ndarray:
        _kernel()(forces[steps], steps, T_s / steps, tuple(map(float, values(x))), model)
        error = (model - y)[first:] / stroke
        return np.where(np.isfinite(error), np.clip(error, -1e3, 1e3), 1e3)

    starts = [
        (float(np.sum(left(start, COARSE) ** 2)), start)
        for start in first_guesses(m, c, k, reach, free_nu)
    ]
    starts.sort(key=lambda pair: pair[0])
    scale = np.array([1.0, 1.0, 1.0, 1.0, 1.0 / reach, 1.0 / reach, *([1.0] if free_nu else [])])
    low, high = np.full(len(scale), -np.inf), np.full(len(scale), np.inf)
    if free_nu:
        low[6], high[6] = 1.0, 4.0
    tries = [
        least_squares(left, x, args=(COARSE,), bounds=(low, high), x_scale=scale, max_nfev=40)
        for _, x in starts[:3]
    ]
    best = min(tries, key=lambda found: found.cost)
    found = least_squares(
        left, best.x, bounds=(low, high), x_scale=scale, xtol=1e-13, ftol=1e-13, gtol=1e-13
    )
    rms = float(np.sqrt(np.mean(found.fun**2)))
    if rms > 0.5:
        raise ParameterError(
            f"no parameters simulate the record: {100.0 * rms:.3g} % of its rms are left; give a "
            "record from rest, or leave out its first part"
        )
    half = half_widths(found.jac, rms, len(found.fun))
    p = values(found.x)
    names = (*FREE, "nu") if free_nu else FREE
    to_value = np.array([p.m, p.c, p.k, p.alpha, 1.0 / beta, 1.0 / beta, 1.0])
    widths = dict(zip(names, (half * to_value[: len(names)]).tolist(), strict=True))
    sentences = [
        "Only beta gamma and beta delta are determined, not beta: gamma and delta are stated for "
        f"beta = {beta:g}."
    ]
    sentences += [
        f"{name} is not determined: its 95 % interval is wider than its value."
        for name, width in widths.items()
        if width > abs(getattr(p, name))
    ]
    return OscillatorFit(p, widths, rms * stroke, tuple(sentences))
