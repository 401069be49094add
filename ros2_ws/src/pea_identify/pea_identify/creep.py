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
from typing import NamedTuple

import numpy as np

from pea_core.params import ParameterError
from pea_identify.intervals import Z_95, inverse_of_normal
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
    # the hold is the longest stretch without a move: a soft return after it is a move, too
    longest = int(np.argmax(np.diff(np.append(moves, len(u)))))
    first, last = int(moves[0]), int(moves[longest]) + 1
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


class Averages(NamedTuple):
    """Averages of a hold over times that grow by a ratio; every other one is held out.

    t (s), y (m), sigma (m): time after the step, displacement since before it, its deviation.
    noise (m): deviation of one sample.  odd: those held out.
    """

    t: np.ndarray
    y: np.ndarray
    sigma: np.ndarray
    noise: float
    odd: np.ndarray


def averaged(t: np.ndarray, y: np.ndarray, y_before: float, edges: np.ndarray) -> Averages:
    """Averages of y (m) at t (s) between `edges` (s); `y_before` (m) is the level before."""
    place = np.searchsorted(edges, t, side="right") - 1
    count = np.bincount(place, minlength=len(edges))[: len(edges) - 1]
    used = count > 0
    mean_t = (np.bincount(place, t, len(edges))[:-1][used]) / count[used]
    mean_y = (np.bincount(place, y, len(edges))[:-1][used]) / count[used]
    scatter = y - np.concatenate([mean_y, [0.0]])[np.cumsum(used)[place] - 1]
    noise = max(float(np.sqrt(np.mean(scatter**2))), 1e-15)
    sigma = noise / np.sqrt(count[used]) + 1e-5 * abs(mean_y[0] - y_before)
    return Averages(mean_t, mean_y - y_before, sigma, noise, np.arange(len(mean_t)) % 2 == 1)


def choose(of: Averages, settled: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time constants (s) of the fewest operators that predict what is held out.

    Besides, what they leave of the averages held out and of the others (m).
    """
    trials: list[tuple[float, np.ndarray, np.ndarray, np.ndarray]] = []
    t, y, sigma = of.t[~of.odd], of.y[~of.odd], of.sigma[~of.odd]
    for n in COUNTS:
        tau = times(t, y, sigma, n, settled)
        solution = solve(t, y, sigma, tau)
        apart = columns(of.t, tau) @ solution - of.y
        if trials and np.abs(solution[1:]).sum() > MOST * abs(solution[0]):
            break  # operators that take the place of the instantaneous part
        misfit = float(np.mean((apart / of.sigma)[of.odd] ** 2))
        trials.append((misfit, tau, apart[of.odd], apart[~of.odd]))
    least = min(trial[0] for trial in trials)
    _, tau, apart, inside = next(trial for trial in trials if trial[0] <= 1.05 * least)
    return tau, apart, inside


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
    y_before = float(y[max(0, first - 5000) : first + 1].mean())
    edges = np.geomspace(settled, t[-1] + T_s, max(int(POINTS * math.log10(t[-1] / settled)), 16))
    of = averaged(t[keep], y[keep], y_before, edges)
    tau, apart, inside = choose(of, settled)
    solution = solve(of.t, of.y, of.sigma, tau)
    A = solution[0]
    if abs(A) < 5.0 * of.noise:
        raise ParameterError(
            f"{record.name}: the step moves the stage by {abs(A):.3g} m, noise is {of.noise:.3g} "
            "m: make a larger step"
        )
    model = columns(of.t, tau) @ solution
    active = solution[1:] > 1e-6 * abs(A) if A > 0 else solution[1:] < -1e-6 * abs(A)
    tau, amounts = tau[active], solution[1:][active]
    misfit = max(float(np.mean(((model - of.y) / of.sigma) ** 2)), 1.0)
    log_tau, weights_of, total = deviations(of, tau, A, amounts, misfit)
    return Creep(
        tau=tau,
        weights=amounts / A,
        tau_95=Z_95 * tau * log_tau,
        weights_95=Z_95 * weights_of,
        total=float((amounts / A).sum()),
        total_95=Z_95 * total,
        duration=float(t[-1]),
        fitted=float(np.sqrt(np.mean(inside**2))),
        held_out=float(np.sqrt(np.mean(apart**2))),
        t=of.t,
        y=of.y + y_before,
        model=model + y_before,
    )


def deviations(
    of: Averages, tau: np.ndarray, A: float, amounts: np.ndarray, misfit: float
) -> tuple[np.ndarray, np.ndarray, float]:
    """Standard deviations of log tau, of the weights and of their sum, from the fit's Jacobian."""
    slow = -amounts * (of.t[:, None] / tau) * np.exp(-of.t[:, None] / tau)  # by log tau
    J = np.hstack([columns(of.t, tau), slow]) / of.sigma[:, None]
    covariance = inverse_of_normal(J) * misfit
    n, weights = len(tau), amounts / A
    to_weights = np.hstack([-weights[:, None] / A, np.eye(n) / A])
    own = to_weights @ covariance[: n + 1, : n + 1] @ to_weights.T
    total = float(np.sqrt(max(float(own.sum()), 0.0)))
    return np.sqrt(np.diag(covariance)[n + 1 :]), np.sqrt(np.diag(own)), total


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
