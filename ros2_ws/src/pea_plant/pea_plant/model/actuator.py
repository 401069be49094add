r"""The actuator: u -> H -> F_c -> V -> y, Fig 2 with F_c in front of V as Section II allows.

H is evaluated once a sample with the voltage really applied and held over the interval; F_c
and V then step exactly (joint zero-order-hold discretisation, matrix exponential). External
loads add to the output of H, Eq 1.

Inputs
    command u (V), white noise of unit variance.
Outputs
    `Measurement`: y (m), true velocity (m/s) if the sensor is ideal, applied voltage (V).
State
    hysteresis, linear states, the voltage applied last and the one that waits.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

from pea_core.nominal import NominalModel, hold
from pea_core.params import ParameterError, choice, group, param
from pea_core.signals import Measurement
from pea_plant.model import creep, hysteresis, sensor
from pea_plant.model.vibration import second_order
from pea_plant.safety import limit


@dataclass(frozen=True)
class Params(NominalModel):
    """The simulated actuator with its amplifier's limits and its sensor."""

    x10_um: float = param(0.0, "um", -1e4, 1e4, help="initial displacement", fixed=True)
    x20_um_s: float = param(0.0, "um/s", -1e9, 1e9, help="initial velocity", fixed=True)
    hysteresis: Any = choice(
        hysteresis.CHOICE.kinds, hysteresis.CHOICE.default, help=hysteresis.CHOICE.spec.help
    )
    creep: creep.Params = group(creep.Params)
    sensor: sensor.Params = group(sensor.Params)
    delay_samples: int = param(0, "", 0, 1, help="samples before a command acts", fixed=True)
    voltage_min: float = param(-20.0, "V", -1e4, 1e4, help="lowest voltage applied")
    voltage_max: float = param(110.0, "V", -1e4, 1e4, help="highest voltage applied")
    seed: int = param(1, "", 0, 2**31 - 1, help="seed of the sensor noise", fixed=True)

    def __post_init__(self) -> None:
        if self.voltage_min >= self.voltage_max:
            raise ParameterError(
                f"voltage_min = {self.voltage_min:g}: must be below voltage_max "
                f"({self.voltage_max:g} V)"
            )


class Coefficients(NamedTuple):
    """Discretised actuator; n linear states.

    h : coefficients of H.  A_d (n, n), B_d (n): exact step.  C_1, C_2 (n): displacement (m)
    and velocity (m/s) from the states; C_3 (n), D_3: acceleration (m/s^2).  x_0 (n): start.
    """

    h: Any
    A_d: np.ndarray
    B_d: np.ndarray
    C_1: np.ndarray
    C_2: np.ndarray
    C_3: np.ndarray
    D_3: float
    x_0: np.ndarray
    noise: float
    ideal: bool
    delayed: bool
    voltage_min: float
    voltage_max: float


class State(NamedTuple):
    """h: state of H.  x (n): linear states; x_next (n): room for the next.

    v (V): what drove V during the last interval.  u_applied (V): voltage during it.
    u_waiting (V): command that acts one sample later where there is a delay.
    """

    h: Any
    x: np.ndarray
    x_next: np.ndarray
    v: float
    u_applied: float
    u_waiting: float


class Truth(NamedTuple):
    """Displacement (m), velocity (m/s) and acceleration (m/s^2) at the end of an interval."""

    x1: float
    x2: float
    x2_dot: float


def linear(params: Params) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """F_c then V as one system: A (n, n), B (n, 1), C (1, n), from H's output (V) to y (m)."""
    A_v, B_v, C_v = second_order.continuous(params)
    A_c, B_c, C_c = creep.continuous(params.creep)
    n_v, n_c = len(A_v), len(A_c)
    A = np.block([[A_v, B_v @ C_c], [np.zeros((n_c, n_v)), A_c]])
    return A, np.vstack([B_v, B_c]), np.hstack([C_v, np.zeros((1, n_c))])


def dot(a: np.ndarray, b: np.ndarray) -> float:
    """Sum of products in index order: the same bits everywhere, unlike BLAS."""
    total = 0.0
    for i in range(a.size):
        total += a[i] * b[i]
    return total


def actuator(params: Params) -> SimpleNamespace:
    """The model (`pea_core.block`) of an actuator with the hysteresis that `params` choose."""
    H = hysteresis.MODELS[hysteresis.CHOICE.type_of(params.hysteresis)]
    h_start, h_output, h_update = H.start, H.output, H.update

    def design(params: Params, T_s: float) -> Coefficients:
        A, B, C = linear(params)
        A_d, B_d = hold(A, B, T_s)
        x_0 = np.zeros(len(A))
        x_0[0], x_0[1] = params.x10_um * 1e-6, params.x20_um_s * 1e-6
        return Coefficients(
            h=H.design(params.hysteresis, T_s),
            A_d=A_d,
            B_d=B_d[:, 0].copy(),
            C_1=C[0],
            C_2=(C @ A)[0],
            C_3=(C @ A @ A)[0],
            D_3=float((C @ A @ B)[0, 0]),
            x_0=x_0,
            noise=params.sensor.noise_nm * 1e-9,
            ideal=params.sensor.ideal,
            delayed=params.delay_samples > 0,
            voltage_min=params.voltage_min,
            voltage_max=params.voltage_max,
        )

    def start(c: Coefficients) -> State:
        return State(h_start(c.h), c.x_0.copy(), np.empty_like(c.x_0), 0.0, 0.0, 0.0)

    def output(c: Coefficients, s: State, noise: float) -> Measurement:
        y = dot(c.C_1, s.x) + c.noise * noise
        y_dot = dot(c.C_2, s.x) if c.ideal else math.nan
        return Measurement(y, y_dot, s.u_applied)

    def update(c: Coefficients, s: State, noise: float, measured: Measurement, u: float) -> State:
        u_limited = limit(u, c.voltage_min, c.voltage_max)
        u_applied = s.u_waiting if c.delayed else u_limited
        h = h_update(c.h, s.h, u_applied)
        v = h_output(c.h, h)
        for i in range(c.B_d.size):
            s.x_next[i] = dot(c.A_d[i], s.x) + c.B_d[i] * v
        return State(h, s.x_next, s.x, v, u_applied, u_limited)

    def truth(c: Coefficients, s: State) -> Truth:
        return Truth(dot(c.C_1, s.x), dot(c.C_2, s.x), dot(c.C_3, s.x) + c.D_3 * s.v)

    return SimpleNamespace(
        Params=Params, design=design, start=start, output=output, update=update, truth=truth
    )
