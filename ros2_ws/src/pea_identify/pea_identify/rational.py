r"""Rational approximation of frequency responses with common poles: vector fitting.

.. math:: G(z) = \sum_i \frac{R_i}{z - p_i} + \sum_{k=0}^{d-1} D_k z^{-k}

The poles of all entries are relocated until they stay: each round solves, in least squares,

.. math:: \sum_i \frac{c_i}{z - p_i} + \sum_k D_k z^{-k}
          - G(z) \sum_i \frac{\tilde c_i}{z - p_i} = G(z)

where the new poles are the zeros of 1 + sum c~_i/(z - p_i), mirrored into the unit circle, so
that the model is stable always. Source: B. Gustavsen and A. Semlyen, IEEE Trans. Power
Delivery 14(3), 1999; in z, with a QR factorisation for each entry.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

ROUNDS = 20


class Rational(NamedTuple):
    """A stable discrete model with common poles.

    Attributes
    ----------
    poles : (n,) array
        In z; of each complex pair the one with positive imaginary part.
    residues : (m, n_y, n_u) array
        Real coefficients: for a real pole the residue, for a pair the real part, then the
        imaginary part, of half the residue's conjugate; m is the number of states an input.
    direct : (d, n_y, n_u) array
        D_k, impulse response that no pole makes.
    T_s : float
        Sample period (s).
    """

    poles: np.ndarray
    residues: np.ndarray
    direct: np.ndarray
    T_s: float

    @property
    def parameters(self) -> int:
        """Count of free real parameters."""
        return int(self.residues.shape[0] + self.residues.size + self.direct.size)

    def __call__(self, f: np.ndarray) -> np.ndarray:
        """Response (F, n_y, n_u) at frequencies f (Hz)."""
        z = np.exp(2j * math.pi * np.asarray(f) * self.T_s)
        powers = z[:, None] ** -np.arange(len(self.direct))
        return np.tensordot(basis(z, self.poles), self.residues, 1) + np.tensordot(
            powers, self.direct, 1
        )

    def simulate(self, u: np.ndarray) -> np.ndarray:
        """Displacements (N, n_y) from voltages u (N, n_u), from rest.

        y(k) follows from u(0) to u(k): with the direct part, u(k) acts at once.
        """
        from scipy.signal import lfilter

        N, n_u = u.shape
        y = np.zeros((N, self.residues.shape[1]))
        row = 0
        for p in self.poles:
            wide = 1 if p.imag == 0.0 else 2
            for j in range(n_u):
                if wide == 1:
                    parts = [lfilter([0.0, 1.0], [1.0, -p.real], u[:, j])]
                else:  # 1/(z - p) + 1/(z - p*), and j (1/(z - p) - 1/(z - p*))
                    a = [1.0, -2.0 * p.real, abs(p) ** 2]
                    parts = [
                        lfilter([0.0, 2.0, -2.0 * p.real], a, u[:, j]),
                        lfilter([0.0, 0.0, -2.0 * p.imag], a, u[:, j]),
                    ]
                for i, part in enumerate(parts):
                    y += part[:, None] * self.residues[row + i, :, j]
            row += wide
        for k, D in enumerate(self.direct):
            y[k:] += u[: N - k] @ D.T
        return y


def basis(z: np.ndarray, poles: np.ndarray) -> np.ndarray:
    """Partial fractions (F, m) with real coefficients, one column a real pole, two a pair."""
    columns = []
    for p in poles:
        if p.imag == 0.0:
            columns.append(1.0 / (z - p.real))
        else:
            a, b = 1.0 / (z - p), 1.0 / (z - np.conj(p))
            columns += [a + b, 1j * (a - b)]
    return np.array(columns).T


def real(a: np.ndarray) -> np.ndarray:
    """Real parts over imaginary parts: complex rows as real ones."""
    return np.concatenate([a.real, a.imag])


def spread(f_low: float, f_high: float, pairs: int, T_s: float, reals: int = 0) -> np.ndarray:
    """Poles to begin with: `pairs` lightly damped ones between two frequencies (Hz)."""
    angles = 2.0 * math.pi * T_s * np.linspace(f_low, f_high, pairs)
    damped = np.exp(-0.01 * angles) * np.exp(1j * angles)
    return np.concatenate([damped, np.linspace(0.9, 0.5, reals) + 0j])


def fit(
    f: np.ndarray,
    G: np.ndarray,
    weight: np.ndarray,
    T_s: float,
    poles: np.ndarray,
    direct: int = 1,
    rounds: int = ROUNDS,
) -> Rational:
    """Fit a rational model.

    Parameters
    ----------
    f : (F,) array
        Frequencies (Hz).
    G : (F, n_y, n_u) array
        Response (m/V).
    weight : (F, n_y, n_u) array
        Weight of each entry's error, 1 over its standard deviation.
    T_s : float
        Sample period (s).
    poles : (n,) array
        To begin with, see `spread`.
    direct : int
        Count d of direct terms.
    rounds : int
        Relocations of the poles.
    """
    z = np.exp(2j * math.pi * f * T_s)
    shape = G.shape[1:]
    G, W = G.reshape(len(f), -1), weight.reshape(len(f), -1)
    extra = z[:, None] ** -np.arange(direct)
    for _ in range(rounds):
        poles = relocated(z, G, W, poles, extra)
    columns = np.hstack([basis(z, poles), extra])
    C = np.empty((columns.shape[1], G.shape[1]))
    for j in range(G.shape[1]):
        w = W[:, j : j + 1]
        C[:, j] = np.linalg.lstsq(real(columns * w), real(G[:, j] * W[:, j]), rcond=None)[0]
    n = columns.shape[1] - direct
    return Rational(poles, C[:n].reshape(n, *shape), C[n:].reshape(direct, *shape), T_s)


def relocated(
    z: np.ndarray, G: np.ndarray, W: np.ndarray, poles: np.ndarray, extra: np.ndarray
) -> np.ndarray:
    """The poles after one round: zeros of the common denominator, within the unit circle."""
    B = basis(z, poles)
    n, k = B.shape[1], B.shape[1] + extra.shape[1]
    columns = np.hstack([B, extra])
    rows, right = [], []
    for j in range(G.shape[1]):
        w, g = W[:, j : j + 1], G[:, j : j + 1]
        A = np.hstack([real(columns * w), real(-g * B * w), real(g * w)])
        R = np.asarray(np.linalg.qr(A, mode="r"))
        rows.append(R[k : k + n, k : k + n])
        right.append(R[k : k + n, -1])
    A = np.vstack(rows)
    scale = np.linalg.norm(A, axis=0)
    c = np.linalg.lstsq(A / scale, np.concatenate(right), rcond=None)[0] / scale
    M, b, i = np.zeros((n, n)), np.zeros(n), 0
    for p in poles:
        if p.imag == 0.0:
            M[i, i], b[i] = p.real, 1.0
            i += 1
        else:
            M[i : i + 2, i : i + 2] = [[p.real, p.imag], [-p.imag, p.real]]
            b[i] = 2.0
            i += 2
    new = np.linalg.eigvals(M - np.outer(b, c))
    new = np.where(np.abs(new) > 1.0, 1.0 / np.conj(new), new)
    near_real = np.abs(new.imag) < 1e-12
    new = np.where(near_real, new.real, new)
    kept = new[new.imag >= 0.0]
    return kept[np.argsort(np.abs(np.angle(kept)))]
