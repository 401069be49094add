"""The loop of the bench once more, written out by hand for numba: a yardstick, never used to run.

One function of plain numbers, for this one combination of blocks: second-order actuator behind
Bouc-Wen hysteresis, extended-state observer, PIDSMC, sine. What the compiled blocks cost beyond
it is the price of blocks that can be exchanged.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from pea_controller.model import pidsmc
from pea_experiment.experiment import Experiment
from pea_observer.model import extended_state
from pea_plant.model.actuator import actuator
from pea_reference.model import sine


def coefficients(experiment: Experiment) -> tuple[float, ...]:
    """Every number that `by_hand` needs, designed by the models."""
    T_s = experiment.T_s
    params = {name: node.params for name, node in experiment.nodes.items()}
    p = actuator(params["plant"]).design(params["plant"], T_s)
    o = extended_state.design(params["observer"], T_s)
    c = pidsmc.design(params["controller"], T_s)
    r = sine.design(params["reference"], T_s)
    return (
        *(*p.A_d.ravel().tolist(), *p.B_d.tolist(), *p.C_y.tolist(), p.sensor.noise),
        *(p.h.alpha, p.h.k_up, p.h.k_down, p.amplifier.voltage_min, p.amplifier.voltage_max),
        *o,
        *(c.A21, c.A22, c.B2, c.m, c.P, c.I_T, c.D, c.actuator.low, c.actuator.high),
        *(r.amplitude, r.offset, r.omega, r.phase, r.T_s),
    )


def by_hand(numbers: tuple[float, ...], noise: np.ndarray, rows: np.ndarray) -> None:
    """Run from rest, one row a sample, as `SAMPLE`."""
    (a11, a12, a21, a22, b1, b2, c1, c2, rms, alpha, up, down, u_min, u_max) = numbers[:14]
    (f11, f12, f13, f21, f22, f23, g1, g2, l1, l2, l3) = numbers[14:25]
    (A21, A22, B2, m, P, I_T, D, low, high) = numbers[25:34]
    (amplitude, offset, omega, phase, T_s) = numbers[34:]
    x1 = x2 = u_applied = h = z1 = z2 = eps = v_I = 0.0
    for k in range(noise.size):
        angle = omega * (k * T_s) + phase
        sine = amplitude * math.sin(angle)
        w, w_dot = offset + sine, amplitude * omega * math.cos(angle)
        w_ddot = -omega * omega * sine
        y = c1 * x1 + c2 * x2 + rms * noise[k]
        p1 = f11 * z1 + f12 * z2 + f13 * eps + g1 * u_applied
        p2 = f21 * z1 + f22 * z2 + f23 * eps + g2 * u_applied
        r = y - p1
        z1, z2, eps = p1 + l1 * r, p2 + l2 * r, eps + l3 * r
        e1, e2 = z1 - w, z2 - w_dot
        q = m * e1 + e2
        integral = v_I + I_T * q
        u = (w_ddot - A21 * w - A22 * w_dot) / B2 - (m * e2 + A21 * e1 + A22 * e2) / B2
        u -= (P * q + integral) / D
        if not math.isfinite(u):
            return
        rows[k, 0], rows[k, 1], rows[k, 2] = w, w_dot, w_ddot
        rows[k, 3], rows[k, 4], rows[k, 5] = y, math.nan, u_applied
        rows[k, 6], rows[k, 7], rows[k, 8], rows[k, 9] = z1, z2, eps, u
        if low <= u <= high:
            v_I = integral
        reached = min(max(u, u_min), u_max)
        if reached != u_applied:
            sign = 1.0 if reached > u_applied else -1.0
            z, left, rate = sign * h, abs(reached - u_applied), up
            if z < 0.0:
                rate = down
                to_zero = math.log1p(-z * down / alpha) / down
                if to_zero < left:
                    z, left, rate = 0.0, left - to_zero, up
            h = sign * (z - (alpha / rate - z) * math.expm1(-rate * left))
            u_applied = reached
        v = u_applied - h
        x1, x2 = a11 * x1 + a12 * x2 + b1 * v, a21 * x1 + a22 * x2 + b2 * v


def compiled() -> Callable[..., None]:
    """`by_hand`, compiled."""
    import numba

    fast: Callable[..., None] = numba.njit(by_hand, nogil=True, cache=True)
    return fast
