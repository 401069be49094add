r"""F_c from a step: first-order operators whose weights are not negative.

After a step of the voltage that the vibration has forgotten,

.. math:: y(t) = y_0 + A \Bigl(1 + \sum_i w_i (1 - e^{-t/\tau_i})\Bigr)

tau_i minimise the error, A and A w_i follow by least squares with bounds for each of them. The
count of operators is the smallest one whose error on samples not fitted is within 5 % of the
least. Samples are averaged over intervals that grow with t, so each decade counts alike.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from pea_core.params import ParameterError
from pea_identify.records import Record

COUNTS = (1, 2, 3, 4, 5)
"""Operators that are tried."""

MOST = 0.5
"""Creep (share of the instantaneous displacement) beyond which a fit is not believed."""

POINTS = 40
"""Averages a decade."""

MOVES = 1e-3
"""Share of a step beyond which a change from sample to sample is part of its move."""

HOLDS = 4.0
"""Least length of a hold, in the time that the vibration takes to die away."""

Z_95 = 1.959964


@dataclass(frozen=True)
class Creep:
    """Identified creep.

    Attributes
    ----------
    tau : (n,) array
        Time constants (s); none: no creep above the noise.
    weights : (n,) array
        Shares of the instantaneous displacement.
    tau_95, weights_95 : (n,) arrays
        Half widths of 95 % intervals.
    total, total_95 : float
        Sum of the weights, and the half width of its 95 % interval.
    duration : float
        Length of the record after the step (s): creep beyond is not determined.
    fitted, held_out : float
        Rms error (m) of averages that were fitted, and that were not.
    t, y, model : (m,) arrays
        Averages (s, m), and the model there.
    """

    tau: np.ndarray
    weights: np.ndarray
    tau_95: np.ndarray
    weights_95: np.ndarray
    total: float
    total_95: float
    duration: float
    fitted: float
    held_out: float
    t: np.ndarray
    y: np.ndarray
    model: np.ndarray

    @property
    def grown(self) -> float:
        """Share of the instantaneous displacement that the hold has shown."""
        return float(self.weights @ -np.expm1(-self.duration / self.tau))

    @property
    def doubt(self) -> float:
        """Error of the averages as such a share: what is grown has to be larger by far."""
        moved = float(self.weights @ -np.expm1(-(self.t[-1] - self.t[0]) / self.tau))
        size = abs(float(self.model[-1] - self.model[0]))
        return self.fitted * moved / size if size > 0.0 else math.inf

    def __call__(self, v: np.ndarray, T_s: float) -> np.ndarray:
        """F_c's output along v (N, …), held a sample each, from rest."""
        return through(v, self.tau, self.weights, T_s)

    def response(self, f: np.ndarray) -> np.ndarray:
        """F_c (F,) at frequencies f (Hz)."""
        s = 2j * math.pi * f[:, None]
        return 1.0 + (self.weights / (self.tau * s + 1.0)).sum(axis=1)


def hold_of(u: np.ndarray) -> tuple[int, int, int]:
    """Last sample before the move of a step (N,), first of its hold, first after the hold.

    The hold ends where the voltage leaves its level, however slowly.
    """
    span = float(np.ptp(u))
    moves = np.flatnonzero(np.abs(np.diff(u)) > MOVES * span)
    first, last = int(moves[0]), int(moves[-1]) + 1
    off = np.abs(u - float(np.median(u[last:]))) / span
    last += int(np.argmax(off[last:] <= MOVES))  # a soft move has a slow end
    left = np.flatnonzero(off[last:] > 0.01)
    return first, last, last + int(left[0]) if len(left) else len(u)


def through(v: np.ndarray, tau: np.ndarray, weights: np.ndarray, T_s: float) -> np.ndarray:
    """v (N, …) plus first-order operators of it, each held a sample of T_s (s), from rest."""
    from scipy.signal import lfilter

    out = v.astype(float)
    for tau_i, w_i in zip(tau, weights, strict=True):
        a = math.exp(-T_s / tau_i)
        out = out + w_i * lfilter([0.0, 1.0 - a], [1.0, -a], v, axis=0)
    return out


def identify(record: Record, settled: float) -> Creep:
    """Identify F_c.

    Parameters
    ----------
    record : Record
        A step: rest, one move, and a long hold.
    settled : float
        Time after the step (s) from which V has no part in the motion any more.

    Raises
    ------
    ParameterError
        The hold is shorter than `HOLDS` times `settled`, or y does not follow.
    """
    u, y, T_s = record.u[:, 0], record.y[:, 0], record.T_s
    first, last, end = hold_of(u)
    u, y = u[:end], y[:end]
    # creep begins on the way: a soft move counts as a jump in its middle
    middle = first + int(np.argmax(np.abs(u[first:] - u[first]) >= 0.5 * abs(u[last] - u[first])))
    t = (np.arange(len(u)) - middle) * T_s
    settled += (last - middle) * T_s
    keep = t >= settled
    if keep.sum() < 32 or t[-1] < HOLDS * settled:
        raise ParameterError(
            f"{record.name}: {max(t[-1], 0.0):.3g} s after the step are too short for creep: hold "
            f"the voltage for at least {HOLDS * settled:.3g} s"
        )
    before = y[max(0, first - 5000) : first + 1]
    y_before = float(before.mean())
    edges = np.geomspace(settled, t[-1] + T_s, max(int(POINTS * math.log10(t[-1] / settled)), 16))
    place = np.searchsorted(edges, t[keep], side="right") - 1
    count = np.bincount(place, minlength=len(edges))[: len(edges) - 1]
    used = count > 0
    mean_t = (np.bincount(place, t[keep], len(edges))[:-1][used]) / count[used]
    mean_y = (np.bincount(place, y[keep], len(edges))[:-1][used]) / count[used]
    scatter = y[keep] - np.concatenate([mean_y, [0.0]])[np.cumsum(used)[place] - 1]
    noise = max(float(np.sqrt(np.mean(scatter**2))), 1e-15)
    sigma = noise / np.sqrt(count[used]) + 1e-5 * abs(mean_y[0] - y_before)
    odd = np.arange(len(mean_t)) % 2 == 1
    trials: list[Any] = []
    for n in COUNTS:
        tau = times(mean_t[~odd], mean_y[~odd] - y_before, sigma[~odd], n, settled)
        solution = solve(mean_t[~odd], mean_y[~odd] - y_before, sigma[~odd], tau)
        apart = columns(mean_t, tau) @ solution - (mean_y - y_before)
        if trials and np.abs(solution[1:]).sum() > MOST * abs(solution[0]):
            break  # operators that take the place of the instantaneous part
        trials.append((float(np.mean((apart / sigma)[odd] ** 2)), tau, apart[odd], apart[~odd]))
    least = min(trial[0] for trial in trials)
    _, tau, apart, inside = next(trial for trial in trials if trial[0] <= 1.05 * least)
    solution = solve(mean_t, mean_y - y_before, sigma, tau)
    A = solution[0]
    if abs(A) < 5.0 * noise:
        raise ParameterError(
            f"{record.name}: the step moves the stage by {abs(A):.3g} m, noise is {noise:.3g} m: "
            "make a larger step"
        )
    active = solution[1:] > 1e-6 * abs(A) if A > 0 else solution[1:] < -1e-6 * abs(A)
    model = columns(mean_t, tau) @ solution
    tau, amounts = tau[active], solution[1:][active]
    slow = -amounts * (mean_t[:, None] / tau) * np.exp(-mean_t[:, None] / tau)  # by log tau
    J = np.hstack([columns(mean_t, tau), slow]) / sigma[:, None]
    misfit = max(float(np.mean(((model - mean_y + y_before) / sigma) ** 2)), 1.0)
    scale = np.maximum(np.linalg.norm(J, axis=0), 1e-300)
    covariance = np.linalg.pinv((J / scale).T @ (J / scale)) / np.outer(scale, scale) * misfit
    n, weights = len(tau), amounts / A
    to_weights = np.hstack([-weights[:, None] / A, np.eye(n) / A])
    own = to_weights @ covariance[: n + 1, : n + 1] @ to_weights.T
    return Creep(
        tau=tau,
        weights=weights,
        tau_95=Z_95 * tau * np.sqrt(np.diag(covariance)[n + 1 :]),
        weights_95=Z_95 * np.sqrt(np.diag(own)),
        total=float(weights.sum()),
        total_95=Z_95 * float(np.sqrt(max(float(own.sum()), 0.0))),
        duration=float(t[-1]),
        fitted=float(np.sqrt(np.mean(inside**2))),
        held_out=float(np.sqrt(np.mean(apart**2))),
        t=mean_t,
        y=mean_y,
        model=model + y_before,
    )


def times(t: np.ndarray, y: np.ndarray, sigma: np.ndarray, n: int, settled: float) -> np.ndarray:
    """The n time constants (s) that fit best, from a logarithmic grid on."""
    from scipy.optimize import least_squares

    def left(x: np.ndarray) -> np.ndarray:
        tau = np.exp(x)
        return (columns(t, tau) @ solve(t, y, sigma, tau) - y) / sigma

    low, high = math.log(settled), math.log(10.0 * t[-1])
    first = np.linspace(math.log(settled), math.log(10.0 * t[-1]), n + 2)[1:-1]
    found = least_squares(left, first, bounds=(low, high), max_nfev=100)
    return np.sort(np.exp(found.x))


def columns(t: np.ndarray, tau: np.ndarray) -> np.ndarray:
    """Columns (m, 1 + n): one, and what each operator has grown to at t (s)."""
    return np.hstack([np.ones((len(t), 1)), -np.expm1(-t[:, None] / tau)])


def solve(t: np.ndarray, y: np.ndarray, sigma: np.ndarray, tau: np.ndarray) -> np.ndarray:
    """A and A w_i that fit best, all of the sign of A."""
    from scipy.optimize import nnls

    sign = math.copysign(1.0, float(np.mean(y)))
    return sign * nnls(columns(t, tau) / sigma[:, None], sign * y / sigma)[0]
