"""Signals between blocks, one sample each, in SI units (m, m/s, m/s^2, V)."""

from typing import NamedTuple

import numpy as np


class Reference(NamedTuple):
    """Desired displacement W of Eq 3, with the second derivative that Eq 7 needs.

    Attributes
    ----------
    w, w_dot, w_ddot : float
        Desired displacement (m), velocity (m/s), acceleration (m/s^2) at t_k.
    """

    w: float
    w_dot: float
    w_ddot: float


class Measurement(NamedTuple):
    """What the plant tells at t_k.

    Attributes
    ----------
    y : float
        Measured displacement (m).
    y_dot : float
        True velocity (m/s) of an ideal sensor; NaN where the sensor gives none.
    u_applied : float
        Voltage (V) that drove the actuator during the interval that ended at t_k.
    """

    y: float
    y_dot: float
    u_applied: float


class Estimate(NamedTuple):
    """What the observer makes of it at t_k.

    Attributes
    ----------
    x1, x2 : float
        Displacement (m) and velocity (m/s).
    eps : float
        Lumped unknown input (V) of Eq 2.
    """

    x1: float
    x2: float
    eps: float


SAMPLE = np.dtype(
    [
        ("w", "<f8"),
        ("w_dot", "<f8"),
        ("w_ddot", "<f8"),
        ("y", "<f8"),
        ("y_dot", "<f8"),
        ("u_applied", "<f8"),
        ("x1_hat", "<f8"),
        ("x2_hat", "<f8"),
        ("eps_hat", "<f8"),
        ("u", "<f8"),
    ]
)
"""One sample of the loop: `Reference`, `Measurement`, `Estimate` and the command u_k."""

TRUTH = np.dtype([("x1", "<f8"), ("x2", "<f8"), ("eps", "<f8")])
"""What only a simulated plant knows at t_k: its states and the lumped unknown input."""


def between(a: Reference, b: Reference, theta: float, T_s: float) -> Reference:
    """Reference at the fraction `theta` (0 to 1) of the interval from `a` to `b`.

    Velocity and acceleration come from the cubic that meets both ends' velocities and
    accelerations, displacement from its integral that starts at `a`; the error is of
    order T_s^4 in the velocity.
    """
    h = theta * T_s
    slope = (b.w_dot - a.w_dot) / T_s
    c2 = (3.0 * slope - 2.0 * a.w_ddot - b.w_ddot) / T_s
    c3 = (a.w_ddot + b.w_ddot - 2.0 * slope) / (T_s * T_s)
    return Reference(
        a.w + h * (a.w_dot + h * (a.w_ddot / 2.0 + h * (c2 / 3.0 + h * c3 / 4.0))),
        a.w_dot + h * (a.w_ddot + h * (c2 + h * c3)),
        a.w_ddot + h * (2.0 * c2 + h * 3.0 * c3),
    )
