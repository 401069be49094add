r"""Frequency responses with their uncertainty, from periodic data or from any record.

From periodic data, R experiments of P whole periods each, n_u experiments a block whose
excitations are independent (one experiment is a block where there is one input):

.. math:: G_b(f) = Y_b U_b^{-1}, \quad G = \frac{1}{B} \sum_b G_b

the best linear approximation. What differs from period to period is noise; what differs from
block to block (other phases, the same spectrum) is noise and nonlinearity.

From any record: Welch's averaged spectra, G = S_yu S_uu^{-1}, with the ordinary (one input) or
multiple (several inputs) coherence.

Sources: R. Pintelon and J. Schoukens, System Identification: A Frequency Domain Approach, 2nd
edition, Sections 2.4, 4.3; J. S. Bendat and A. G. Piersol, Random Data, Section 9.2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pea_core.params import ParameterError

LEAST, LEAST_PERIODIC = 1e-6, 3e-3
"""Share of the largest line below which a line is not excited: power in a record, amplitude of
periods, where a measured voltage has noise at every line."""


@dataclass(frozen=True)
class FrequencyResponse:
    """A measured frequency response.

    Attributes
    ----------
    f : (F,) array
        Frequencies (Hz), rising.
    G : (F, n_y, n_u) array
        Response (m/V).
    noise : (F, n_y, n_u) array
        Variance of G from the noise (m²/V²); NaN where the data do not determine it.
    total : (F, n_y, n_u) array
        Variance of G from noise and nonlinearity (m²/V²); NaN likewise.
    coherence : (F, n_y) array
        Share of the output's power that the inputs explain linearly, 0 to 1; NaN likewise.
    T_s : float
        Sample period (s).
    """

    f: np.ndarray
    G: np.ndarray
    noise: np.ndarray
    total: np.ndarray
    coherence: np.ndarray
    T_s: float

    @property
    def variance(self) -> np.ndarray:
        """The larger of both variances (F, n_y, n_u); NaN where neither is determined."""
        return np.fmax(self.noise, self.total)

    @property
    def nonlinear(self) -> np.ndarray:
        """Variance of G from the nonlinearity alone (F, n_y, n_u)."""
        return np.maximum(self.total - self.noise, 0.0)

    def within(self, low: float, high: float) -> FrequencyResponse:
        """The lines from low to high (Hz)."""
        return self.at((self.f >= low) & (self.f <= high))

    def at(self, keep: np.ndarray) -> FrequencyResponse:
        """The lines at which `keep` (F,) is true."""
        return FrequencyResponse(
            self.f[keep],
            self.G[keep],
            self.noise[keep],
            self.total[keep],
            self.coherence[keep],
            self.T_s,
        )


def channels(values: np.ndarray, name: str) -> np.ndarray:
    """`values` as (samples, channels, experiments, periods); missing axes are of length one.

    Raises
    ------
    ParameterError
        More than four axes, or a value that is not finite.
    """
    values = np.asarray(values, dtype=float)
    if not 1 <= values.ndim <= 4:
        raise ParameterError(f"{name} has {values.ndim} axes: give (samples, channels, …)")
    if bad := int(np.count_nonzero(~np.isfinite(values))):
        raise ParameterError(f"{name} has {bad} values that are not finite: cut or mend them first")
    return values.reshape(values.shape + (1,) * (4 - values.ndim))


def excited(U: np.ndarray) -> np.ndarray:
    """Lines (indices) at which every input is excited in some experiment; U (F, n_u, R)."""
    size = np.abs(U).max(axis=2)
    return np.flatnonzero((size > LEAST_PERIODIC * size[1:].max(axis=0)).all(axis=1))


def by_blocks(U: np.ndarray, Y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Response (F, B, n_y, n_u) of each block of n_u experiments, and the inverse of its inputs.

    U (F, n_u, R), Y (F, n_y, R) with R = B n_u.

    Raises
    ------
    ParameterError
        The inputs of a block do not determine a response.
    """
    F, n_u, R = U.shape
    blocks_U = U.reshape(F, n_u, R // n_u, n_u).transpose(0, 2, 1, 3)
    blocks_Y = Y.reshape(F, -1, R // n_u, n_u).transpose(0, 2, 1, 3)
    if not np.abs(blocks_U).max(axis=(2, 3)).all():
        raise ParameterError("a line of u is not excited in every experiment: name fewer lines")
    worst = np.linalg.cond(blocks_U).max() if n_u > 1 else 1.0
    if not worst < 1e6:
        raise ParameterError(
            f"the excitations of {n_u} inputs are not independent (condition {worst:.2g}): "
            "use orthogonal multisines"
        )
    inverse = np.linalg.inv(blocks_U)
    return blocks_Y @ inverse, inverse


def from_periods(
    u: np.ndarray, y: np.ndarray, T_s: float, lines: np.ndarray | None = None
) -> FrequencyResponse:
    """Response from whole periods of a periodic excitation, in steady state.

    Parameters
    ----------
    u : (N, n_u, R, P) array
        Voltages (V) held from each sample on: N samples a period, R experiments, P periods.
    y : (N, n_y, R, P) array
        Displacements (m) at the samples.
    T_s : float
        Sample period (s).
    lines : (F,) array of int, optional
        Multiples of 1/(N T_s) that are excited; found from u where omitted, without 0.

    Raises
    ------
    ParameterError
        Shapes differ, R is no multiple of n_u, or the excitation is not rich enough.
    """
    u, y = channels(u, "u"), channels(y, "y")
    N, n_u, R, P = u.shape
    if (y.shape[0], *y.shape[2:]) != (N, R, P):
        raise ParameterError(f"u is {u.shape} and y is {y.shape}: all but the channels must agree")
    if R % n_u:
        raise ParameterError(
            f"{R} experiments for {n_u} inputs: give {n_u}, or a multiple of it, whose "
            "excitations are independent"
        )
    U_p, Y_p = np.fft.rfft(u, axis=0) / N, np.fft.rfft(y, axis=0) / N
    U, Y = U_p.mean(axis=3), Y_p.mean(axis=3)
    if lines is None:
        lines = excited(U)
        lines = lines[(lines > 0) & (lines < N / 2)]
    if not len(lines):
        raise ParameterError("no line of u is excited: drive the stage first")
    U, Y, U_p, Y_p = U[lines], Y[lines], U_p[lines], Y_p[lines]
    G_b, inverse = by_blocks(U, Y)
    G, B = G_b.mean(axis=1), R // n_u
    # what an output's error of variance s² becomes in a row of G: s² diag((U U^H)^-1)
    spread = (np.abs(inverse) ** 2).sum(axis=2)  # (F, B, n_u)
    total = np.full(G.shape, np.nan)
    if B > 1:
        total = (np.abs(G_b - G[:, None]) ** 2).sum(axis=1) / (B * (B - 1))
    noise = np.full(G.shape, np.nan)
    if P > 1:
        left = Y_p - np.einsum("fij,fjrp->firp", G, U_p)
        var_Y = (np.abs(left - left.mean(axis=3, keepdims=True)) ** 2).sum(axis=3) / (P * (P - 1))
        var_Y = var_Y.reshape(len(lines), -1, B, n_u).mean(axis=3)  # (F, n_y, B)
        noise = np.einsum("fib,fbj->fij", var_Y, spread) / B**2
    coherence = np.full(Y.shape[:2], np.nan)
    if B > 1:
        left = Y - np.einsum("fij,fjr->fir", G, U)
        degrees = R * (1.0 - 1.0 / B)
        power = (np.abs(Y) ** 2).sum(axis=2)
        coherence = 1.0 - np.minimum((np.abs(left) ** 2).sum(axis=2) / power * R / degrees, 1.0)
    f = np.asarray(lines) / (N * T_s)
    return FrequencyResponse(f, G, noise, total, coherence, T_s)


def from_record(
    u: np.ndarray, y: np.ndarray, T_s: float, resolution_hz: float | None = None
) -> FrequencyResponse:
    """Response from a record of any excitation, by Welch's method with a Hann window.

    Parameters
    ----------
    u : (N, n_u) array
        Voltages (V).
    y : (N, n_y) array
        Displacements (m).
    T_s : float
        Sample period (s).
    resolution_hz : float, optional
        Distance between two lines; without it, 16 segments, half overlapping.

    Raises
    ------
    ParameterError
        Too short for the resolution, or inputs that cannot be distinguished.
    """
    from scipy.signal import csd

    u, y = channels(u, "u")[..., 0, 0], channels(y, "y")[..., 0, 0]
    N, n_u = u.shape
    if len(y) != N:
        raise ParameterError(f"u has {N} samples and y {len(y)}: give as many")
    segment = int(2 * N / 17) if resolution_hz is None else round(1.0 / (resolution_hz * T_s))
    if segment < 16 or 4 * segment > N:
        raise ParameterError(
            f"{N} samples are too few for segments of {segment}: record longer, at least "
            f"{4 * max(segment, 16)} samples"
        )
    options = {"fs": 1.0 / T_s, "nperseg": segment, "axis": 0}
    f, _ = csd(u[:, 0], u[:, 0], **options)

    def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        rows = [[csd(b_j, a_i, **options)[1] for b_j in b.T] for a_i in a.T]
        return np.array(rows).transpose(2, 0, 1)  # (F, a, b): a conj(b)

    S_uu, S_yu, S_yy = cross(u, u), cross(y, u), cross(y, y)
    power = np.abs(np.einsum("fii->fi", S_uu))
    keep = (f > 0) & (power > LEAST * power.max(axis=0)).all(axis=1)
    f, S_uu, S_yu, S_yy = f[keep], S_uu[keep], S_yu[keep], S_yy[keep]
    if not f.size or np.linalg.cond(S_uu).min() > 1e8:
        raise ParameterError("the inputs cannot be distinguished: excite them independently")
    inverse = np.linalg.inv(S_uu)
    G = S_yu @ inverse
    S_y = np.einsum("fii->fi", S_yy).real
    explained = np.einsum("fij,fji->fi", G, S_yu.conj().transpose(0, 2, 1)).real
    coherence = np.clip(explained / S_y, 0.0, 1.0)
    averages = (2 * N / segment - 1) * 0.5 * (18.0 / 11.0)  # half overlapping Hann, Welch 1967
    left = S_y * (1.0 - coherence) * averages / max(averages - n_u, 1.0)
    total = np.einsum("fi,fj->fij", left, np.einsum("fii->fi", inverse).real) / averages
    return FrequencyResponse(f, G, np.full(G.shape, np.nan), total, coherence, T_s)
