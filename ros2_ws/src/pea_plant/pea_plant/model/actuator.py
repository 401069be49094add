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

V may be late by tau = (n + f) T_s, n whole and f below one (`vibration.Delayed`). Then the
interval from t_k sees the end of v_{k-n-1} for f T_s and v_{k-n} after that, which is exact too,

.. math:: x_{k+1} = \Phi x_k + e^{A (1 - f) T_s} \Gamma(f T_s)\, v_{k-n-1}
          + \Gamma((1 - f) T_s)\, v_{k-n}, \quad \Gamma(t) = \int_0^t e^{A s} B\, ds

and likewise for a lagging v(t).

Inputs
    command u (V), white noise of unit variance.
Outputs
    `Measurement`: y (m), true velocity (m/s) if the sensor is ideal, applied voltage (V)
    after limits, DAC, delay and slew rate, before the amplifier's bandwidth: what a controller
    can know without measuring the amplifier. The bandwidth is part of the actuator's dynamics,
    and so of the lumped unknown input.
State
    hysteresis, linear states, the voltage applied last and those that wait, the amplifier's
    output, the sample number, what a delayed V has not seen and a delayed sensor has not told
    yet, the gate's state.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

from pea_core.nominal import NominalModel, hold
from pea_core.params import ParameterError, choice, group, param
from pea_core.signals import Measurement
from pea_plant import gate as safety_gate
from pea_plant.model import amplifier, creep, hysteresis, load, sensor, vibration

DELAY_MAX = 20
"""Most samples that a command waits."""


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
    delay_samples: int = param(
        0, "", 0, DELAY_MAX, help="samples before a command acts", fixed=True
    )
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


class Late(NamedTuple):
    """A delay of V: whole samples n, and what the end of the interval before does.

    B_d (n): of v_{k-n-1} on the states.  B_a (n): of its lag.
    """

    whole: int
    B_d: np.ndarray
    B_a: np.ndarray


class Coefficients(NamedTuple):
    """Discretised actuator; n linear states, the sensor's lag the last if there is one.

    h, load, gate, amplifier, sensor : coefficients of the blocks.
    A_d (n, n), B_d (n): exact step.  B_a (n): correction for a v(t) that lags.
    late: of a delay of V, see `Late`.
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
    late: Late
    C_y: np.ndarray
    C_1: np.ndarray
    C_2: np.ndarray
    C_3: np.ndarray
    D_3: float
    x_0: np.ndarray
    delay: int


class State(NamedTuple):
    """k: sample number.  h: state of H.  x (n): linear states; x_next (n): room for the next.

    v (V): what drives F_c and V at the end of the last interval.  u_applied (V): voltage during
    it.  waiting (d): commands that act later where there is a delay, the next one first (V).
    u_a (V): output of the amplifier's lag.  on_way (n + 2, 2): inputs of a delayed V, the oldest
    first, and by how much each of them fell (V).  past (d): what a delayed sensor has seen (m).
    gate: state of the safety gate.
    """

    k: int
    h: Any
    x: np.ndarray
    x_next: np.ndarray
    v: float
    u_applied: float
    waiting: np.ndarray
    u_a: float
    on_way: np.ndarray
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


def lagging(A: np.ndarray, B: np.ndarray, pole: float, t: float, before: float, T_s: float) -> Any:
    r"""Effect (n) on the states, over t, of v falling from one to zero as the amplifier's lag does.

    .. math:: B_a = \int_0^t e^{A (t - s)} B \frac{e^{-pole\,(s + before)} - a}{1 - a} ds
    """
    n = len(A)
    with_lag = np.block([[A, B], [np.zeros((1, n)), np.full((1, 1), -pole)]])
    decaying = hold(with_lag, np.zeros((n + 1, 1)), t)[0][:n, n]
    held = hold(A, B, t)[1][:, 0]
    decaying = math.exp(-pole * before) * decaying
    return (decaying - math.exp(-pole * T_s) * held) / -math.expm1(-pole * T_s)


def inputs(
    A: np.ndarray, B: np.ndarray, delay: float, pole: float, T_s: float
) -> tuple[np.ndarray, np.ndarray, Late]:
    """How v of one interval, held or lagging, acts on the states: B_d, B_a and `Late`.

    Parameters
    ----------
    A, B : (n, n) and (n, 1) array
        Continuous system.
    delay : float
        Of V (s).
    pole : float
        Of the amplifier's lag (rad/s); 0: none.
    T_s : float
        Sample period (s).
    """
    whole, fraction = split(delay, T_s)
    first, rest = fraction * T_s, (1.0 - fraction) * T_s  # under v_{k-n-1}, under v_{k-n}
    onward, B_d = hold(A, B, rest)
    none = np.zeros(len(A))
    B_a = lagging(A, B, pole, rest, 0.0, T_s) if pole else none
    B_late, B_a_late = none, none
    if fraction:
        B_late = onward @ hold(A, B, first)[1][:, 0]
        B_a_late = onward @ lagging(A, B, pole, first, rest, T_s) if pole else none
    return B_d[:, 0].copy(), B_a, Late(whole, B_late, B_a_late)


def split(delay: float, T_s: float) -> tuple[int, float]:
    """Whole samples of a delay (s), and the fraction of one that is left."""
    samples = delay / T_s
    nearest = round(samples)
    if abs(samples - nearest) < 1e-9:
        return nearest, 0.0
    return math.floor(samples), samples - math.floor(samples)


def dot(a: np.ndarray, b: np.ndarray) -> float:
    """Sum of products in index order: the same bits everywhere, unlike BLAS."""
    total = 0.0
    for i in range(a.size):
        total += a[i] * b[i]
    return float(total)


def model_of_H(params: Params) -> Any:
    """The model of the hysteresis that is chosen."""
    return hysteresis.MODELS[hysteresis.CHOICE.type_of(params.hysteresis)]


def model_of_load(params: Params) -> Any:
    """The model of the load that is chosen."""
    return load.MODELS[load.CHOICE.type_of(params.load)]


def design(params: Params, T_s: float) -> Coefficients:
    """Discretise the blocks that `params` choose.

    Raises
    ------
    ParameterError
        One of them cannot be designed.
    """
    H, LOAD = model_of_H(params), model_of_load(params)
    A, B, C = linear(params)
    A_s, B_s, C_s = sensor.behind(params.sensor, A, B, C)
    A_d, _ = hold(A_s, B_s, T_s)
    n = len(A_s)
    pole = 2.0 * math.pi * params.amplifier.bandwidth_hz
    B_d, B_a, of_delay = inputs(A_s, B_s, params.vibration.delay, pole, T_s)
    seen = np.zeros((3, n))
    seen[:, : len(A)] = *C, *C @ A, *C @ A @ A
    return Coefficients(
        h=H.design(params.hysteresis, T_s),
        load=LOAD.design(params.load, T_s, steady_state_gain(params)),
        gate=safety_gate.design(params.safety, params.voltage_min, params.voltage_max, T_s),
        amplifier=amplifier.design(params.amplifier, params.voltage_min, params.voltage_max, T_s),
        sensor=sensor.design(params.sensor),
        A_d=A_d,
        B_d=B_d,
        B_a=B_a,
        late=of_delay,
        C_y=C_s[0].copy(),
        C_1=seen[0].copy(),
        C_2=seen[1].copy(),
        C_3=seen[2].copy(),
        D_3=float((C @ A @ B)[0, 0]),
        x_0=initial(params, n),
        delay=params.delay_samples,
    )


def truth(c: Coefficients, s: State) -> Truth:
    """Where the stage really is."""
    return Truth(dot(c.C_1, s.x), dot(c.C_2, s.x), dot(c.C_3, s.x) + c.D_3 * s.v)


def actuator(params: Params) -> SimpleNamespace:
    """The model (`pea_core.block`) of an actuator with the blocks that `params` choose.

    Its ``told`` and ``commit`` are its output and update where the sensor sees `more` (m, m/s), of
    actuators beside it. Parameters that differ in numbers alone have the same model.
    """
    H, LOAD = model_of_H(params), model_of_load(params)
    return _chosen(
        *(H.start, H.output, H.update, LOAD.output, LOAD is not load.none),
        lags=params.amplifier.bandwidth_hz > 0.0,
        waits=params.delay_samples > 0,
        late=params.vibration.delay > 0.0,
        delays=params.sensor.delay_samples > 0,
    )


@cache
def _chosen(
    h_start: Callable[..., Any],
    h_output: Callable[..., float],
    h_update: Callable[..., Any],
    load_output: Callable[..., float],
    loaded: bool,
    *,
    lags: bool,
    waits: bool,
    late: bool,
    delays: bool,
) -> SimpleNamespace:
    """The model of a choice.

    One function, because its kernels close over that choice: what is not chosen is not compiled.
    """
    command, slew, reading = amplifier.command, amplifier.slew, sensor.reading
    gate_start, gated = safety_gate.start, safety_gate.step

    def start(c: Coefficients) -> State:
        return State(
            k=0,
            h=h_start(c.h),
            x=c.x_0.copy(),
            x_next=np.empty_like(c.x_0),
            v=0.0,
            u_applied=0.0,
            waiting=np.zeros(c.delay),
            u_a=0.0,
            on_way=np.zeros((c.late.whole + 2, 2)),
            past=np.full(c.sensor.delay, dot(c.C_y, c.x_0)),
            gate=gate_start(safety_gate.ACTIVE, 0.0),
        )

    def output(c: Coefficients, s: State, noise: float) -> Measurement:
        return told(c, s, noise, 0.0, 0.0)

    def told(c: Coefficients, s: State, noise: float, more: float, more_dot: float) -> Measurement:
        if delays:
            y = s.past[s.k % c.sensor.delay]
        else:
            y = dot(c.C_y, s.x) + more
        y_dot = dot(c.C_2, s.x) + more_dot if c.sensor.ideal else math.nan
        return Measurement(reading(c.sensor, y, noise), y_dot, s.u_applied)

    def update(c: Coefficients, s: State, noise: float, measured: Measurement, u: float) -> State:
        return commit(c, s, measured, u, 0.0)

    def commit(c: Coefficients, s: State, measured: Measurement, u: float, more: float) -> State:
        if delays:
            s.past[s.k % c.sensor.delay] = dot(c.C_y, s.x) + more
        gate = s.gate
        if c.gate.on:
            gate = gated(c.gate, gate, u, True, measured.y, math.nan, 1.0, 1.0)
            u = gate.u
        u_sent = command(c.amplifier, u)
        u_due = u_sent
        if waits:
            u_due = s.waiting[0]
            for i in range(c.delay - 1):
                s.waiting[i] = s.waiting[i + 1]
            s.waiting[c.delay - 1] = u_sent
        u_applied = slew(c.amplifier, s.u_applied, u_due)
        u_a = u_applied
        if lags:
            u_a += c.amplifier.decay * (s.u_a - u_applied)
        v_old = h_output(c.h, s.h)
        h = h_update(c.h, s.h, u_a)
        v_new = h_output(c.h, h)
        fallen = v_old - v_new
        v = v_new
        if loaded:
            v += load_output(c.load, s.k)
        v_end, v_before, fallen_before = v, 0.0, 0.0
        if late:
            n = c.late.whole + 1
            for i in range(n):
                s.on_way[i, 0], s.on_way[i, 1] = s.on_way[i + 1, 0], s.on_way[i + 1, 1]
            s.on_way[n, 0], s.on_way[n, 1] = v, fallen
            v, fallen = s.on_way[1, 0], s.on_way[1, 1]
            v_before, fallen_before = s.on_way[0, 0], s.on_way[0, 1]
            v_end = v
        for i in range(c.B_d.size):
            s.x_next[i] = dot(c.A_d[i], s.x) + c.B_d[i] * v
        if lags:
            for i in range(c.B_a.size):
                s.x_next[i] += c.B_a[i] * fallen
        if late:
            for i in range(c.B_d.size):
                s.x_next[i] += c.late.B_d[i] * v_before + c.late.B_a[i] * fallen_before
        for i in range(c.B_d.size):
            s.x[i] = s.x_next[i]
        return State(
            s.k + 1, h, s.x, s.x_next, v_end, u_applied, s.waiting, u_a, s.on_way, s.past, gate
        )

    return SimpleNamespace(
        Params=Params,
        design=design,
        start=start,
        output=output,
        update=update,
        truth=truth,
        told=told,
        commit=commit,
    )
