r"""V from a frequency response: modes, their gains, and a delay that may be a fraction of a sample.

.. math:: V(s) = e^{-s \tau} \Bigl(1 + \frac{c}{s + a}\Bigr) (1 - j \eta) \frac{1}{1 + s \tau_a}
          \sum_{i=1}^{n} \frac{K_i\,\omega_{n,i}^2}
          {s^2 + 2 \zeta_i \omega_{n,i} s + \omega_{n,i}^2}

the linear combination of second-order systems of Section II. The voltage is held over a sample
(exact, aliases included), or has no content above the band. Three factors may be added:
c/(s + a) is the creep F_c, with a = 0 far above its own frequencies; eta is the phase that
hysteresis adds at every frequency; tau_a is the lag of an amplifier. The memory of Bouc-Wen
hysteresis fades with the path of u; in fast motion it acts like c/(s + a) with a inside the band.

omega_n, zeta, tau and the factors minimise the weighted error; K_i follows linearly for each of
them (variable projection). The weight of a line is 1 over its standard deviation. Intervals come
from the Jacobian at the minimum and from the residual of each line. Among the numbers of modes,
with a fitted or not, whose error on held-out data is within one standard error of the best, the
one with the fewest unknowns is chosen.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pea_identify.frequency_response import FrequencyResponse

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
    creep, corner, loss, lag : float
        c (1/s), a (1/s), eta (1), tau_a (s); 0 where it is not fitted.
    omega_n_95, zeta_95 : (n,) arrays
        Half widths of 95 % intervals.
    K_95 : (n, n_y, n_u) array
    delay_95, creep_95, loss_95, lag_95, gain_95 : float or array
        Likewise; `gain_95` of the sum of K.
    misfit : float
        Mean squared error over the stated variance; 1 where the model explains all.
    T_s : float
        Sample period (s).
    hold : str
        One of `HOLDS`.
    error : float
        Relative rms error of the response on data not fitted; NaN where none were held out.
    tried : tuple of (int, float)
        Counts of modes tried, and the score of each: lower is better.
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
    loss: float = 0.0
    lag: float = 0.0
    corner: float = 0.0
    loss_95: float = 0.0
    lag_95: float = 0.0
    error: float = math.nan
    tried: tuple[tuple[int, float], ...] = ()

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
        factors = Factors(self.delay, self.creep, self.loss, self.lag, self.corner)
        columns = responses(f, self.T_s, self.omega_n, self.zeta, factors, self.hold)
        return np.einsum("fn,nij->fij", columns, self.K)

    def simulate(self, v: np.ndarray) -> np.ndarray:
        """Displacement (N, n_y) in m from voltages (N, n_u) in V held a sample each, from rest.

        Without creep and loss, which a plant models apart.
        """
        from scipy.signal import lfilter

        v = v.reshape(len(v), -1)
        whole, fraction = divmod(self.delay / self.T_s, 1.0)
        y = np.zeros((len(v), self.K.shape[1]))
        poles, residues = partial(self.omega_n, self.zeta, self.lag)
        for pole, residue, of_mode in zip(poles.T, residues.T, self.K, strict=True):
            for p, r in zip(pole, residue, strict=True):
                later = np.expm1(p * (self.T_s * (1.0 - fraction))) / p
                earlier = np.expm1(p * self.T_s) / p - later
                b, a = r * np.array([0.0, later, earlier]), [1.0, -np.exp(p * self.T_s)]
                y += lfilter(b, a, v.astype(complex), axis=0).real @ of_mode.T
        shift = int(whole)
        return np.vstack([np.zeros((shift, y.shape[1])), y[: len(y) - shift]]) if shift else y


class Factors(NamedTuple):
    """Delay (s), creep c (1/s), loss eta, lag tau_a (s), corner a of the creep (1/s)."""

    delay: float
    creep: float = 0.0
    loss: float = 0.0
    lag: float = 0.0
    corner: float = 0.0


def partial(omega_n: np.ndarray, zeta: np.ndarray, lag: float) -> tuple[np.ndarray, np.ndarray]:
    """Poles and residues (2 or 3, n) of modes of gain one behind a lag (s; 0: none)."""
    root = omega_n * np.sqrt(1.0 - np.minimum(zeta, 0.999999) ** 2)
    first = -zeta * omega_n + 1j * root
    half = omega_n**2 / (2j * root)
    if not lag:
        return np.array([first, first.conj()]), np.array([half, half.conj()])
    a = 1.0 / lag
    r = half * a / (first + a)
    third = omega_n**2 * a / ((a + first) * (a + first.conj())) + 0j
    poles = np.array([first, first.conj(), np.full(len(first), -a + 0j)])
    return poles, np.array([r, r.conj(), third])


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
    factors: Factors,
    hold: str,
) -> np.ndarray:
    """Responses (F, n) of modes of gain one, with the factors."""
    s = 2j * math.pi * f
    poles, residues = partial(omega_n, zeta, factors.lag)
    modes = np.zeros((len(f), len(omega_n)), dtype=complex)
    if hold == "band_limited":
        for p, r in zip(poles, residues, strict=True):
            modes += r / (s[:, None] - p)
        modes *= np.exp(-s * factors.delay)[:, None]
    else:
        whole, fraction = divmod(factors.delay / T_s, 1.0)
        for p, r in zip(poles, residues, strict=True):
            modes += r * held(f, T_s, p, fraction)
        modes *= np.exp(-s * T_s * whole)[:, None]
    crept = 1.0 + factors.creep / (s + factors.corner)
    return modes * (crept * (1.0 - 1j * factors.loss))[:, None]


EXTRAS = {
    "creep": (-100.0, 3000.0, 0.0),
    "corner": (0.0, 2.0 * math.pi * 5.0 * CREEP_BELOW, 2.0 * math.pi * 0.2 * CREEP_BELOW),
    "loss": (-0.5, 0.5, 0.0),
    "lag": (1e-3, 100.0, 0.5),
}
"""Factors that may be fitted: lowest, highest and first value; a lag in sample periods."""


class ModesProblem:
    """The fit of a response, with K eliminated.

    Parameters
    ----------
    response : FrequencyResponse
    deviation : (F, n_y, n_u) array
        Standard deviation of each entry (m/V).
    hold : str
    extras : tuple of str
        Which of `EXTRAS` are fitted.
    spectrum : (F,) array, optional
        Spectrum of the voltage (V) of a record that is not periodic: what the stage still does
        of what came before the record, and would do after it, is fitted besides.
    """

    def __init__(
        self,
        response: FrequencyResponse,
        deviation: np.ndarray,
        hold: str,
        extras: tuple[str, ...] = (),
        spectrum: np.ndarray | None = None,
    ) -> None:
        self.spectrum = spectrum
        self.f, self.T_s, self.hold, self.extras = response.f, response.T_s, hold, extras
        self.shape = response.G.shape[1:]
        self.G = response.G.reshape(len(self.f), -1)
        self.w = 1.0 / deviation.reshape(len(self.f), -1)

    def count(self, x: np.ndarray) -> int:
        """Modes of the unknowns x."""
        return (len(x) - 1 - len(self.extras)) // 2

    def unknowns(self, x: np.ndarray) -> int:
        """Unknowns of x, K included."""
        return len(x) + self.count(x) * int(np.prod(self.shape))

    def split(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, Factors]:
        """omega_n, zeta and the factors of the unknowns x."""
        n = self.count(x)
        values = dict(zip(self.extras, x[2 * n + 1 :].tolist(), strict=True))
        if "lag" in values:
            values["lag"] *= self.T_s
        return np.exp(x[:n]), np.exp(x[n : 2 * n]), Factors(float(x[2 * n]) * self.T_s, **values)

    def columns(self, x: np.ndarray) -> np.ndarray:
        """Responses (F, n) of the modes of x; of a record, transients as further columns."""
        omega_n, zeta, factors = self.split(x)
        modes = responses(self.f, self.T_s, omega_n, zeta, factors, self.hold)
        if self.spectrum is None:
            return modes
        z = np.exp(2j * math.pi * self.f * self.T_s)
        more = [z**-k for k in range(1, 3)] + [1.0 / (1.0 - 1.0 / z)]
        for p in partial(omega_n, zeta, 0.0)[0][0]:
            a = np.exp(p * self.T_s)
            one, other = z / (z - a), z / (z - np.conj(a))
            more += [one + other, 1j * (one - other)]
        return np.column_stack([modes, np.array(more).T / self.spectrum[:, None]])

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

        n = self.count(x)
        top = math.log(math.pi / self.T_s)
        low = [*[math.log(2.0 * math.pi)] * n, *[math.log(1e-4)] * n, 0.0]
        high = [*[top] * n, *[math.log(0.995)] * n, 100.0]
        low += [EXTRAS[name][0] for name in self.extras]
        high += [EXTRAS[name][1] for name in self.extras]
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
    # an entry of 0, which noiseless data may have, would weigh without bound
    return np.sqrt(variance + FLOOR**2 * np.maximum(size, 1e-8 * size.max(axis=0)))
