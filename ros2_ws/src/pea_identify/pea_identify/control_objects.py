"""The linear part of a stage as python-control objects: ``ss`` and ``frd``.

Sampled, behind the hold, so they say what a controller sees from sample to sample.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from pea_identify.frequency_response import FrequencyResponse
from pea_identify.modes import Modes, partial
from pea_identify.rational import Rational


def ss(modes: Modes) -> Any:
    """V with its delay, a discrete `control.StateSpace` from voltage (V) to displacement (m)."""
    import control

    T_s = modes.T_s
    poles, residues = partial(modes.omega_n, modes.zeta, modes.lag)
    whole, fraction = divmod(modes.delay / T_s, 1.0)
    n_y, n_u = modes.K.shape[1:]
    A_blocks: list[np.ndarray] = []
    B_now: list[np.ndarray] = []
    B_before: list[np.ndarray] = []
    C_blocks: list[tuple[np.ndarray, np.ndarray]] = []
    for p, r, K in zip(poles.T, residues.T, modes.K, strict=True):
        for i in range(0, len(p), 2):
            a = np.exp(p[i] * T_s)
            later = r[i] * np.expm1(p[i] * T_s * (1.0 - fraction)) / p[i]
            earlier = r[i] * np.expm1(p[i] * T_s) / p[i] - later
            if i + 1 < len(p):  # a pair: twice the real part of one
                A_blocks.append(np.array([[a.real, -a.imag], [a.imag, a.real]]))
                B_now.append(np.array([[later.real], [later.imag]]))
                B_before.append(np.array([[earlier.real], [earlier.imag]]))
                C_blocks.append((np.array([[2.0, 0.0]]), K))
            else:
                A_blocks.append(np.array([[a.real]]))
                B_now.append(np.array([[later.real]]))
                B_before.append(np.array([[earlier.real]]))
                C_blocks.append((np.array([[1.0]]), K))
    from scipy.linalg import block_diag

    A = block_diag(*[np.kron(np.eye(n_u), block) for block in A_blocks])
    now = np.vstack([np.kron(np.eye(n_u), b) for b in B_now])
    before = np.vstack([np.kron(np.eye(n_u), b) for b in B_before])
    C = np.hstack([np.kron(K, c) for c, K in C_blocks])
    d = int(whole) + 1  # the voltages that wait
    n, m = len(A), d * n_u
    A_all, B_all = np.zeros((n + m, n + m)), np.zeros((n + m, n_u))
    A_all[:n, :n] = A
    shift = np.eye(m, k=-n_u)
    A_all[n:, n:] = shift
    B_all[n : n + n_u] = np.eye(n_u)
    A_all[:n, n + (d - 1) * n_u :] = before
    if d == 1:
        B_all[:n] = now
    else:
        A_all[:n, n + (d - 2) * n_u : n + (d - 1) * n_u] = now
    C_all = np.hstack([C, np.zeros((n_y, m))])
    return control.ss(A_all, B_all, C_all, np.zeros((n_y, n_u)), T_s)


def ss_rational(model: Rational) -> Any:
    """A rational model of several axes as a discrete `control.StateSpace`."""
    import control
    from scipy.linalg import block_diag

    n_y, n_u = model.residues.shape[1:]
    A_blocks: list[np.ndarray] = []
    B_blocks: list[np.ndarray] = []
    C_blocks: list[np.ndarray] = []
    row = 0
    for p in model.poles:
        if p.imag == 0.0:
            A_blocks.append(np.kron(np.eye(n_u), [[p.real]]))
            B_blocks.append(np.eye(n_u))
            C_blocks.append(model.residues[row])
            row += 1
        else:
            A_blocks.append(np.kron(np.eye(n_u), [[p.real, -p.imag], [p.imag, p.real]]))
            B_blocks.append(np.kron(np.eye(n_u), [[2.0], [0.0]]))
            pair = model.residues[row : row + 2]
            # 1/(z - p) + 1/(z - p*) and j (1/(z - p) - 1/(z - p*)) of an input of 2
            c = np.zeros((n_y, 2 * n_u))
            c[:, 0::2], c[:, 1::2] = pair[0], -pair[1]
            C_blocks.append(c)
            row += 2
    A, B, C = block_diag(*A_blocks), np.vstack(B_blocks), np.hstack(C_blocks)
    d = len(model.direct) - 1
    D = model.direct[0] if len(model.direct) else np.zeros((n_y, n_u))
    if d > 0:
        A_d = np.eye(d * n_u, k=-n_u)
        B_d = np.vstack([np.eye(n_u), np.zeros(((d - 1) * n_u, n_u))])
        A, B = block_diag(A, A_d), np.vstack([B, B_d])
        C = np.hstack([C, *model.direct[1:]])
    return control.ss(A, B, C, D, model.T_s)


def frd(response: FrequencyResponse) -> Any:
    """A measured response as `control.FrequencyResponseData`, from V to m."""
    import control

    G = np.moveaxis(response.G, 0, -1)
    return control.frd(G, 2.0 * math.pi * response.f)
