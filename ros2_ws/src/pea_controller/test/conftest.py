"""Plants and signals for the tests of control laws, independent of the plant's package."""

import math
from types import FunctionType
from typing import NamedTuple

import numpy as np
import pytest
from scipy.signal import cont2discrete

from pea_core.signals import Estimate, Reference

T_S = 50e-6
ZETA, OMEGA_N, K = 0.82, 5450.0, 0.142e-6
A21, A22, B2 = -(OMEGA_N**2), -2.0 * ZETA * OMEGA_N, K * OMEGA_N**2


class Run(NamedTuple):
    x1: np.ndarray
    x2: np.ndarray
    u: np.ndarray


def bouc_wen(h, u_0, u_1):
    """Bouc-Wen by Runge-Kutta over small voltage steps."""
    steps = max(1, math.ceil(abs(u_1 - u_0) / 0.2))
    du = (u_1 - u_0) / steps

    def slope(h):
        return 0.35 * du - 0.0424 * abs(du) * h - 0.03394 * du * abs(h)

    for _ in range(steps):
        k1 = slope(h)
        k2 = slope(h + k1 / 2)
        k3 = slope(h + k2 / 2)
        h += (k1 + 2 * k2 + 2 * k3 + slope(h + k3)) / 6
    return h


@pytest.fixture(scope="session")
def simulate():
    """A plain loop: nominal plant, true states, optional hysteresis, constant eps and limits."""

    def run(block, w, samples, x0=(0.0, 0.0), hysteresis=False, eps=0.0, limits=None, tell=False):
        T_s = block.T_s
        A, B = np.array([[0.0, 1.0], [A21, A22]]), np.array([[0.0], [B2]])
        F, G = (M.tolist() for M in cont2discrete((A, B, np.eye(2), 0.0 * B), T_s)[:2])
        x1, x2 = x0
        u_last = h = 0.0
        rows = []
        for k in range(samples):
            W = w(k * T_s)
            disturbance = eps(k) if callable(eps) else eps
            u = block.output(W, W, Estimate(x1, x2, disturbance if tell else 0.0))
            block.update()
            rows.append((x1, x2, u))
            applied = min(max(u, limits[0]), limits[1]) if limits else u
            if hysteresis:
                h = bouc_wen(h, u_last, applied)
                u_last = applied
            v = applied - h + disturbance
            x1, x2 = (
                F[0][0] * x1 + F[0][1] * x2 + G[0][0] * v,
                F[1][0] * x1 + F[1][1] * x2 + G[1][0] * v,
            )
        return Run(*np.array(rows).T)

    return run


@pytest.fixture(scope="session")
def sine():
    """offset + amplitude sin(2 pi f t) with its derivatives, in m."""

    def of(f, amplitude=5e-6, offset=5e-6, phase=0.0):
        omega = 2 * math.pi * f

        def w(t):
            s, c = math.sin(omega * t + phase), math.cos(omega * t + phase)
            return Reference(
                offset + amplitude * s, amplitude * omega * c, -amplitude * omega**2 * s
            )

        return w

    return of


@pytest.fixture(scope="session")
def compiled():
    """Compile a function and the plain functions it calls, all unchanged."""
    numba = pytest.importorskip("numba")
    done = {}

    def jit(f):
        if f not in done:
            names = dict(f.__globals__)
            for name in f.__code__.co_names:
                if isinstance(names.get(name), FunctionType):
                    names[name] = jit(names[name])
            done[f] = numba.njit(FunctionType(f.__code__, names, f.__name__))
        return done[f]

    return jit
