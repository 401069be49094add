r"""V from a frequency response: modes, their gains, and a delay that need be no whole sample.

.. math:: V(s) = e^{-s \tau} \Bigl(1 + \frac{c}{s}\Bigr) \sum_{i=1}^{n}
          \frac{K_i\,\omega_{n,i}^2}{s^2 + 2 \zeta_i \omega_{n,i} s + \omega_{n,i}^2}

the linear combination of second-order systems of Section II, behind a voltage that is held for
a sample (exact, aliases included), or one without content beyond the band. c/s is the creep
F_c far above its own frequencies; where no line is low enough, c is 0.

omega_n, zeta, tau and c minimise the weighted error; K_i follows linearly for each of them
(variable projection). The weight is 1 over the standard deviation of each line. Intervals come
from the Jacobian at the minimum, widened where the model leaves more than the stated variance.
The count of modes is the smallest one whose error on data not fitted is within one standard error
of the best.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pea_core.params import ParameterError
from pea_identify.frequency_response import FrequencyResponse

Z_95 = 1.959964
"""Standard deviations of a 95 % interval."""

FLOOR = 3e-4
"""Relative error of a line that no model is asked to go below."""

CREEP_BELOW = 200.0
"""Lines (Hz) below which creep can be seen in a frequency response."""

HOLDS = ("zero_order", "band_limited")


@dataclass(frozen=True)
class Modes:
    """Identified vibration dynamics V.

    Attributes
    ----------
    omega_n, zeta : (n,) arrays
        Natural frequencies (rad/s), rising, and damping ratios.
    K : (n, n_y, n_u) array
        Steady-state gains (m/V).
    delay : float
        tau (s).
    creep : float
        c (1/s).
    omega_n_95, zeta_95 : (n,) arrays
        Half widths of 95 % intervals.
    K_95 : (n, n_y, n_u) array
    delay_95, creep_95, gain_95 : float or array
        Likewise; `gain_95` of the sum of K.
    misfit : float
        Mean squared error over the stated variance; 1 where the model explains all.
    T_s : float
        Sample period (s).
    hold : str
        One of `HOLDS`.
    """

    omega_n: np.ndarray
    zeta: np.ndarray
    K: np.ndarray
    delay: float
    creep: float
    omega_n_95: np.ndarray
    zeta_95: np.ndarray
    K_95: np.ndarray
    delay_95: float
    creep_95: float
    gain_95: np.ndarray
    misfit: float
    T_s: float
    hold: str = HOLDS[0]

    @property
    def gain(self) -> np.ndarray:
        """Gain for small signals, sum of K (n_y, n_u), in m/V."""
        return self.K.sum(axis=0)

    @property
    def shares(self) -> np.ndarray:
        """Largest share (n,) of each mode in the gain of an entry."""
        scale = np.abs(self.K).sum(axis=0)
        return (np.abs(self.K) / scale).max(axis=(1, 2))

    def __call__(self, f: np.ndarray) -> np.ndarray:
        """Response (F, n_y, n_u) at frequencies f (Hz), m/V."""
        columns = responses(f, self.T_s, self.omega_n, self.zeta, self.delay, self.creep, self.hold)
        return np.einsum("fn,nij->fij", columns, self.K)


def held(f: np.ndarray, T_s: float, pole: np.ndarray, fraction: float) -> np.ndarray:
    """Responses (F, n) of 1/(s - pole) sampled, behind a hold and a delay below T_s (s).

    ``fraction`` is the delay over T_s, 0 to 1.
    """
    z = np.exp(2j * math.pi * f * T_s)[:, None]
    a = np.exp(pole * T_s)
    later = np.expm1(pole * (T_s * (1.0 - fraction))) / pole  # of the voltage of this interval
    earlier = (np.expm1(pole * T_s) / pole) - later  # of the one before, still under way
    return (later + earlier / z) / (z - a)


def responses(
    f: np.ndarray,
    T_s: float,
    omega_n: np.ndarray,
    zeta: np.ndarray,
    delay: float,
    creep: float,
    hold: str,
) -> np.ndarray:
    """Responses (F, n) of modes of gain one, with delay (s) and creep (1/s)."""
    s = 2j * math.pi * f
    if hold == "band_limited":
        modes = omega_n**2 / (s[:, None] * (s[:, None] + 2.0 * zeta * omega_n) + omega_n**2)
        modes = modes * np.exp(-s * delay)[:, None]
    else:
        whole, fraction = divmod(delay / T_s, 1.0)
        damped = omega_n * np.sqrt(1.0 - zeta**2 + 0j)
        pole = -zeta * omega_n + 1j * damped
        half = omega_n**2 / (2j * damped)
        other = np.conj(pole) if np.all(zeta < 1.0) else -zeta * omega_n - 1j * damped
        modes = half * (held(f, T_s, pole, fraction) - held(f, T_s, other, fraction))
        modes = modes * np.exp(-s * T_s * whole)[:, None]
    return modes * (1.0 + creep / s)[:, None] if creep else modes


class Problem:
    """The fit of a response, with K eliminated.

    Parameters
    ----------
    response : FrequencyResponse
    deviation : (F, n_y, n_u) array
        Standard deviation of each entry (m/V).
    hold : str
    creeps : bool
        Whether c is fitted.
    """

    def __init__(
        self, response: FrequencyResponse, deviation: np.ndarray, hold: str, creeps: bool
    ) -> None:
        self.f, self.T_s, self.hold, self.creeps = response.f, response.T_s, hold, creeps
        self.shape = response.G.shape[1:]
        self.G = response.G.reshape(len(self.f), -1)
        self.w = 1.0 / deviation.reshape(len(self.f), -1)

    def split(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, float, float]:
        """omega_n, zeta, delay (s) and c (1/s) of the unknowns x."""
        n = (len(x) - 1 - self.creeps) // 2
        c = float(x[-1]) if self.creeps else 0.0
        return np.exp(x[:n]), np.exp(x[n : 2 * n]), float(x[2 * n]) * self.T_s, c

    def columns(self, x: np.ndarray) -> np.ndarray:
        """Responses (F, n) of the modes of x."""
        return responses(self.f, self.T_s, *self.split(x), self.hold)

    def gains(self, columns: np.ndarray) -> np.ndarray:
        """K (n, m) that fits best, real."""
        K = np.empty((columns.shape[1], self.G.shape[1]))
        for j in range(self.G.shape[1]):
            A, b = columns * self.w[:, j : j + 1], self.G[:, j] * self.w[:, j]
            A, b = np.concatenate([A.real, A.imag]), np.concatenate([b.real, b.imag])
            K[:, j] = np.linalg.lstsq(A, b, rcond=None)[0]
        return K

    def left(self, x: np.ndarray, K: np.ndarray | None = None) -> np.ndarray:
        """Weighted error, real parts over imaginary parts, of the best K or a given one."""
        columns = self.columns(x)
        K = self.gains(columns) if K is None else K
        error = ((columns @ K - self.G) * self.w).T.ravel()
        return np.concatenate([error.real, error.imag])

    def solve(self, x: np.ndarray) -> tuple[np.ndarray, float]:
        """Unknowns at the minimum near x, and the mean squared error there."""
        from scipy.optimize import least_squares

        n = (len(x) - 1 - self.creeps) // 2
        top = math.log(math.pi / self.T_s)
        low = [*[math.log(2.0 * math.pi)] * n, *[math.log(1e-4)] * n, 0.0]
        high = [*[top] * n, *[math.log(0.995)] * n, 100.0]
        if self.creeps:
            low, high = [*low, -100.0], [*high, 100.0]
        margin = 1e-9 + 1e-9 * np.abs(x)
        x = np.clip(x, np.array(low) + margin, np.array(high) - margin)
        found = least_squares(self.left, x, bounds=(low, high), x_scale="jac", max_nfev=200)
        return found.x, 2.0 * found.cost / self.G.size


def deviation_of(response: FrequencyResponse) -> np.ndarray:
    """Standard deviation (F, n_y, n_u) of each entry, smoothed over neighbouring lines.

    A variance from few experiments scatters by itself; its ratio to |G|² changes slowly, with
    the exception of resonances, where the floor `FLOOR` keeps the weight bounded.
    """
    variance = response.variance
    size = np.abs(response.G) ** 2
    if np.isnan(variance).all():
        variance = np.broadcast_to(1e-4 * np.median(size, axis=0), size.shape)
    elif len(response.f) > 20:
        width = min(21, len(response.f) // 4 * 2 + 1)
        padded = np.pad(variance, ((width // 2, width // 2), (0, 0), (0, 0)), mode="reflect")
        windows = np.lib.stride_tricks.sliding_window_view(padded, width, axis=0)
        variance = windows.mean(axis=-1)
    return np.sqrt(variance + FLOOR**2 * size)


def first_guesses(problem: Problem, omega: np.ndarray) -> list[np.ndarray]:
    """Unknowns of one mode to begin with: the peak, several dampings and delays."""
    peak = float(omega[np.argmax(np.abs(problem.G).max(axis=1))])
    tails = [0.0] if problem.creeps else []
    guesses = []
    for omega_n in {peak, float(omega[len(omega) // 2])}:
        for zeta in (0.01, 0.1, 0.6):
            for delay in np.arange(0.0, 16.0, 1.0):
                x = np.array([math.log(omega_n), math.log(zeta), delay, *tails])
                guesses.append((float(np.sum(problem.left(x) ** 2)), x))
    guesses.sort(key=lambda pair: pair[0])
    return [x for _, x in guesses[:4]]


def with_another(problem: Problem, x: np.ndarray, omega: np.ndarray) -> list[np.ndarray]:
    """Unknowns x with one more mode, where the error is largest and elsewhere."""
    n = (len(x) - 1 - problem.creeps) // 2
    error = problem.left(x).reshape(2, -1, len(omega))
    power = (error**2).sum(axis=(0, 1))
    width = max(3, len(omega) // 100)
    smooth = np.convolve(power, np.ones(width) / width, mode="same")
    places = {float(omega[np.argmax(smooth)]), float(omega[-1]) * 1.3}
    places |= {float(o) for o in np.geomspace(omega[0] * 3.0, omega[-1], 6)}
    guesses = []
    for omega_n in places:
        for zeta in (0.01, 0.1, 0.5):
            more = np.concatenate(
                [x[:n], [math.log(omega_n)], x[n : 2 * n], [math.log(zeta)], x[2 * n :]]
            )
            guesses.append((float(np.sum(problem.left(more) ** 2)), more))
    guesses.sort(key=lambda pair: pair[0])
    return [more for _, more in guesses[:3]]


def fit(
    response: FrequencyResponse,
    held_out: FrequencyResponse | None = None,
    most: int = 6,
    hold: str = HOLDS[0],
) -> Modes:
    """Identify V.

    Parameters
    ----------
    response : FrequencyResponse
        Of the stage, small amplitude.
    held_out : FrequencyResponse, optional
        At the same lines, from other experiments: decides the count of modes. Without it,
        Schwarz's criterion decides.
    most : int
        Largest count of modes tried.
    hold : str
        What lies between the samples of u: one of `HOLDS`.

    Raises
    ------
    ParameterError
        Too few lines.
    """
    if len(response.f) < 8:
        raise ParameterError(
            f"{len(response.f)} lines are too few for a mode: excite at least 8 frequencies"
        )
    omega = 2.0 * math.pi * response.f
    creeps = bool(response.f[0] < CREEP_BELOW)
    problem = Problem(response, deviation_of(response), hold, creeps)
    check = None if held_out is None else Problem(held_out, deviation_of(held_out), hold, creeps)
    starts = first_guesses(problem, omega)
    tried: list[tuple[np.ndarray, float, float]] = []
    for n in range(1, most + 1):
        solutions = [problem.solve(x) for x in starts]
        x, cost = min(solutions, key=lambda pair: pair[1])
        size = problem.G.size
        if check is None:
            unknowns = len(x) + n * problem.G.shape[1]
            score = 2.0 * size * math.log(cost) + unknowns * math.log(2.0 * size)
            error = 0.0
        else:
            left = check.left(x, problem.gains(problem.columns(x)))
            squares = (left.reshape(2, -1) ** 2).sum(axis=0)
            score, error = float(squares.mean()), float(squares.std() / math.sqrt(size))
        tried.append((x, score, error))
        if len(tried) > 2 and score > tried[-2][1] and tried[-2][1] >= tried[-3][1] * 0.999:
            break
        if 2 * (n + 1) * 3 > len(omega):
            break
        starts = with_another(problem, x, omega)
    best = min(tried, key=lambda trial: trial[1])
    x = next(x for x, score, _ in tried if score <= best[1] + best[2])
    return intervals(problem, x)


def intervals(problem: Problem, x: np.ndarray) -> Modes:
    """The modes of x, with 95 % intervals."""
    omega_n, zeta, delay, creep = problem.split(x)
    order = np.argsort(omega_n)
    n = len(order)
    x = np.concatenate([x[:n][order], x[n : 2 * n][order], x[2 * n :]])
    omega_n, zeta, delay, creep = problem.split(x)
    K = problem.gains(problem.columns(x))
    whole = np.concatenate([x, K.ravel()])

    def left(theta: np.ndarray) -> np.ndarray:
        return problem.left(theta[: len(x)], theta[len(x) :].reshape(K.shape))

    J = np.empty((2 * problem.G.size, len(whole)))
    steps = 1e-6 * np.maximum(
        np.abs(whole), np.concatenate([np.ones(len(x)), np.abs(K).max() * np.ones(K.size)])
    )
    for i, step in enumerate(steps):
        theta = whole.copy()
        theta[i] += step
        above = left(theta)
        theta[i] -= 2.0 * step
        J[:, i] = (above - left(theta)) / (2.0 * step)
    free = 2 * problem.G.size - len(whole)
    misfit = float(np.sum(left(whole) ** 2) / free * 2.0)
    scale = np.linalg.norm(J, axis=0)
    covariance = np.linalg.pinv((J / scale).T @ (J / scale)) / np.outer(scale, scale)
    covariance *= max(misfit, 1.0) / 2.0  # real and imaginary part share a line's variance
    half = Z_95 * np.sqrt(np.diag(covariance))
    add = np.zeros((K.shape[1], len(whole)))
    for j in range(K.shape[1]):
        add[j, len(x) + j :: K.shape[1]] = 1.0
    gain_95 = Z_95 * np.sqrt(np.einsum("jk,kl,jl->j", add, covariance, add))
    shape = (n, *problem.shape)
    return Modes(
        omega_n=omega_n,
        zeta=zeta,
        K=K.reshape(shape),
        delay=delay,
        creep=creep,
        omega_n_95=half[:n] * omega_n,
        zeta_95=half[n : 2 * n] * zeta,
        K_95=half[len(x) :].reshape(shape),
        delay_95=float(half[2 * n] * problem.T_s),
        creep_95=float(half[2 * n + 1]) if problem.creeps else 0.0,
        gain_95=gain_95.reshape(problem.shape),
        misfit=misfit,
        T_s=problem.T_s,
        hold=problem.hold,
    )
