r"""The actuator: u -> gate -> amplifier -> H -> F_c -> V -> sensor, Fig 2.

F_c stands in front of V, as Section II allows. The external load f_e adds to the output of H,
Eq 1, and so passes F_c as well.

H is evaluated once a sample with the voltage really applied and held over the interval; F_c
and V, and the sensor's lag, then step exactly (joint zero-order-hold discretisation, matrix
exponential). The load is held at its value at t_k: it lags a continuous one by T_s/2.

Where the amplifier has a bandwidth, H is evaluated at the voltage u_a(t_{k+1}) that the lag
has reached, and its output goes from the old value v to the new one v_+ as the lag goes,

.. math:: v(t) = v_+ - (v_+ - v) \frac{e^{-(t - t_k)/\tau} - a}{1 - a}, \quad
          a = e^{-T_s/\tau},

which is exact without hysteresis; with it, only the curvature of the branch within one
interval is neglected: second order, at T_s = 50 us at most 0.01 nm at 10 Hz and 0.4 nm at
150 Hz (80 V peak to peak), and up to 17 nm just after a jump of 45 V. Without a bandwidth
v(t) = v_+.

Inputs
    command u (V), white noise of unit variance.
Outputs
    `Measurement`: y (m), true velocity (m/s) if the sensor is ideal, applied voltage (V)
    after limits, DAC, delay and slew rate, before the amplifier's bandwidth: what a controller
    can know without measuring the amplifier. The bandwidth is part of the actuator's dynamics,
    and so of the lumped unknown input.
State
    hysteresis, linear states, the voltage applied last and the one that waits, the amplifier's
    output, the sample number, what a delayed sensor has not told yet, the gate's state.
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
from pea_plant import gate as safety_gate
from pea_plant.model import amplifier, creep, hysteresis, load, sensor, vibration


@dataclass(frozen=True)
class Params(NominalModel):
    """The simulated actuator with its amplifier and its sensor."""

    x10_um: float = param(0.0, "um", -1e4, 1e4, help="initial displacement", fixed=True)
    x20_um_s: float = param(0.0, "um/s", -1e9, 1e9, help="initial velocity", fixed=True)
    hysteresis: Any = choice(
        hysteresis.CHOICE.kinds, hysteresis.CHOICE.default, help=hysteresis.CHOICE.spec.help
    )
    vibration: Any = choice(
        vibration.CHOICE.kinds, vibration.CHOICE.default, help=vibration.CHOICE.spec.help
    )
    creep: Any = choice(creep.CHOICE.kinds, creep.CHOICE.default, help=creep.CHOICE.spec.help)
    load: Any = choice(load.CHOICE.kinds, load.CHOICE.default, help=load.CHOICE.spec.help)
    amplifier: amplifier.Params = group(amplifier.Params)
    sensor: sensor.Params = group(sensor.Params)
    delay_samples: int = param(0, "", 0, 1, help="samples before a command acts", fixed=True)
    voltage_min: float = param(-20.0, "V", -1e4, 1e4, help="lowest voltage applied")
    voltage_max: float = param(110.0, "V", -1e4, 1e4, help="highest voltage applied")
    safety: safety_gate.Params = group(safety_gate.Params)
    seed: int = param(1, "", 0, 2**31 - 1, help="seed of the sensor noise", fixed=True)

    def __post_init__(self) -> None:
        if self.voltage_min >= self.voltage_max:
            raise ParameterError(
                f"voltage_min = {self.voltage_min:g}: must be below voltage_max "
                f"({self.voltage_max:g} V)"
            )


class Coefficients(NamedTuple):
    """Discretised actuator; n linear states, the sensor's lag the last if there is one.

    h, load, gate, amplifier, sensor : coefficients of the blocks.
    A_d (n, n), B_d (n): exact step.  B_a (n): correction for a v(t) that lags.
    C_y (n): what the sensor sees (m).  C_1, C_2 (n): displacement (m) and velocity (m/s) from
    the states; C_3 (n), D_3: acceleration (m/s^2).  x_0 (n): start.
    """

    h: Any
    load: Any
    gate: safety_gate.Coefficients
    amplifier: amplifier.Coefficients
    sensor: sensor.Coefficients
    A_d: np.ndarray
    B_d: np.ndarray
    B_a: np.ndarray
    C_y: np.ndarray
    C_1: np.ndarray
    C_2: np.ndarray
    C_3: np.ndarray
    D_3: float
    x_0: np.ndarray
    delayed: bool


class State(NamedTuple):
    """k: sample number.  h: state of H.  x (n): linear states; x_next (n): room for the next.

    v (V): input of F_c and V at the end of the last interval.  u_applied (V): voltage during
    it.  u_waiting (V): command that acts one sample later where there is a delay.  u_a (V):
    output of the amplifier's lag.  past (d): what a delayed sensor has seen (m).
    gate: state of the safety gate.
    """

    k: int
    h: Any
    x: np.ndarray
    x_next: np.ndarray
    v: float
    u_applied: float
    u_waiting: float
    u_a: float
    past: np.ndarray
    gate: safety_gate.State


class Truth(NamedTuple):
    """Displacement (m), velocity (m/s) and acceleration (m/s^2) at the end of an interval."""

    x1: float
    x2: float
    x2_dot: float


def linear(params: Params) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """F_c then V as one system: A (n, n), B (n, 1), C (1, n), from H's output (V) to y (m)."""
    V = vibration.MODELS[vibration.CHOICE.type_of(params.vibration)]
    A_v, B_v, C_v = V.continuous(params, params.vibration)
    A_c, B_c, C_c = creep.continuous(params.creep)
    n, v = len(A_v) + len(A_c), len(A_v)
    A, B, C = np.zeros((n, n)), np.zeros((n, 1)), np.zeros((1, n))
    A[:v, :v], A[:v, v:], A[v:, v:] = A_v, B_v @ C_c, A_c
    B[:v], B[v:], C[:, :v] = B_v, B_c, C_v
    return A, B, C


def steady_state_gain(params: Params) -> float:
    """K of V (um/V), whatever its type."""
    V = vibration.MODELS[vibration.CHOICE.type_of(params.vibration)]
    A, B, C = V.continuous(params, params.vibration)
    return float(-(C @ np.linalg.solve(A, B))[0, 0] * 1e6)


def initial(params: Params, n: int) -> np.ndarray:
    """Linear states (n) at the start: no creep yet, the sensor's lag settled."""
    V = vibration.MODELS[vibration.CHOICE.type_of(params.vibration)]
    x = V.initial(params.vibration, params.x10_um * 1e-6, params.x20_um_s * 1e-6)
    x_0 = np.zeros(n)
    x_0[: x.size] = x
    if params.sensor.bandwidth_hz:
        x_0[-1] = params.x10_um * 1e-6
    return x_0


def lagging(A: np.ndarray, B: np.ndarray, B_d: np.ndarray, pole: float, T_s: float) -> np.ndarray:
    r"""Effect B_a (n) on the states of v falling from one to zero as the amplifier's lag does.

    .. math:: B_a = \int_0^{T_s} e^{A (T_s - t)} B \frac{e^{-pole\,t} - a}{1 - a} dt
    """
    n = len(A)
    with_lag = np.block([[A, B], [np.zeros((1, n)), np.full((1, 1), -pole)]])
    decaying = hold(with_lag, np.zeros((n + 1, 1)), T_s)[0][:n, n]
    return (decaying - math.exp(-pole * T_s) * B_d) / -math.expm1(-pole * T_s)


def dot(a: np.ndarray, b: np.ndarray) -> float:
    """Sum of products in index order: the same bits everywhere, unlike BLAS."""
    total = 0.0
    for i in range(a.size):
        total += a[i] * b[i]
    return float(total)


def actuator(params: Params) -> SimpleNamespace:
    """The model (`pea_core.block`) of an actuator with the blocks that `params` choose."""
    H = hysteresis.MODELS[hysteresis.CHOICE.type_of(params.hysteresis)]
    h_start, h_output, h_update = H.start, H.output, H.update
    LOAD = load.MODELS[load.CHOICE.type_of(params.load)]
    load_output, loaded = LOAD.output, LOAD is not load.none
    lags = params.amplifier.bandwidth_hz > 0.0
    delays = params.sensor.delay_samples > 0
    command, slew, reading = amplifier.command, amplifier.slew, sensor.reading
    gate_start, gated = safety_gate.start, safety_gate.step

    def design(params: Params, T_s: float) -> Coefficients:
        A, B, C = linear(params)
        A_s, B_s, C_s = sensor.behind(params.sensor, A, B, C)
        A_d, B_d = hold(A_s, B_s, T_s)
        n = len(A_s)
        B_a = np.zeros(n)
        if lags:
            pole = 2.0 * math.pi * params.amplifier.bandwidth_hz
            B_a = lagging(A_s, B_s, B_d[:, 0], pole, T_s)
        seen = np.zeros((3, n))
        seen[:, : len(A)] = *C, *C @ A, *C @ A @ A
        return Coefficients(
            h=H.design(params.hysteresis, T_s),
            load=LOAD.design(params.load, T_s, steady_state_gain(params)),
            gate=safety_gate.design(params.safety, params.voltage_min, params.voltage_max, T_s),
            amplifier=amplifier.design(
                params.amplifier, params.voltage_min, params.voltage_max, T_s
            ),
            sensor=sensor.design(params.sensor),
            A_d=A_d,
            B_d=B_d[:, 0].copy(),
            B_a=B_a,
            C_y=C_s[0].copy(),
            C_1=seen[0].copy(),
            C_2=seen[1].copy(),
            C_3=seen[2].copy(),
            D_3=float((C @ A @ B)[0, 0]),
            x_0=initial(params, n),
            delayed=params.delay_samples > 0,
        )

    def start(c: Coefficients) -> State:
        return State(
            k=0,
            h=h_start(c.h),
            x=c.x_0.copy(),
            x_next=np.empty_like(c.x_0),
            v=0.0,
            u_applied=0.0,
            u_waiting=0.0,
            u_a=0.0,
            past=np.full(c.sensor.delay, dot(c.C_y, c.x_0)),
            gate=gate_start(safety_gate.ACTIVE, 0.0),
        )

    def output(c: Coefficients, s: State, noise: float) -> Measurement:
        if delays:
            y = s.past[s.k % c.sensor.delay]
        else:
            y = dot(c.C_y, s.x)
        y_dot = dot(c.C_2, s.x) if c.sensor.ideal else math.nan
        return Measurement(reading(c.sensor, y, noise), y_dot, s.u_applied)

    def update(c: Coefficients, s: State, noise: float, measured: Measurement, u: float) -> State:
        if delays:
            s.past[s.k % c.sensor.delay] = dot(c.C_y, s.x)
        gate = s.gate
        if c.gate.on:
            gate = gated(c.gate, gate, u, True, measured.y, math.nan, 1.0)
            u = gate.u
        u_sent = command(c.amplifier, u)
        u_applied = slew(c.amplifier, s.u_applied, s.u_waiting if c.delayed else u_sent)
        u_a = u_applied
        if lags:
            u_a += c.amplifier.decay * (s.u_a - u_applied)
        v_old = h_output(c.h, s.h)
        h = h_update(c.h, s.h, u_a)
        v_new = h_output(c.h, h)
        v = v_new
        if loaded:
            v += load_output(c.load, s.k)
        for i in range(c.B_d.size):
            s.x_next[i] = dot(c.A_d[i], s.x) + c.B_d[i] * v
        if lags:
            for i in range(c.B_a.size):
                s.x_next[i] += c.B_a[i] * (v_old - v_new)
        for i in range(c.B_d.size):
            s.x[i] = s.x_next[i]
        return State(s.k + 1, h, s.x, s.x_next, v, u_applied, u_sent, u_a, s.past, gate)

    def truth(c: Coefficients, s: State) -> Truth:
        return Truth(dot(c.C_1, s.x), dot(c.C_2, s.x), dot(c.C_3, s.x) + c.D_3 * s.v)

    return SimpleNamespace(
        Params=Params, design=design, start=start, output=output, update=update, truth=truth
    )
