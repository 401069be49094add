"""PIDSMC against its linear equivalent, the nominal plant and the figures of the paper."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pea_controller.model import pidsmc
from pea_core.block import Block
from pea_core.params import build, specs
from pea_core.signals import Estimate, Reference

T_S = 50e-6
A21, A22, B2 = -(5450.0**2), -2 * 0.82 * 5450.0, 0.142e-6 * 5450.0**2
REST = Reference(0.0, 0.0, 0.0)
WIDE = {"voltage_min": -1e4, "voltage_max": 1e4}
SET_1 = {"m": 2200.0, "P": 0.004, "I": 0.06, "D_c": 1e-8}
SET_2 = {"m": 22000.0, "P": 0.0004, "I": 1.0, "D_c": 1e-8}


def block(T_s=T_S, **values):
    return Block(pidsmc, build(pidsmc.Params, values), T_s)


def rms_nm(error):
    return 1e9 * np.sqrt(np.mean(error**2))


@pytest.mark.parametrize(
    ("gains", "K_p", "K_i", "K_d", "precision"),
    [(SET_1, 1.818, 132.0, 0.002424, 1e-3), (SET_2, 2.758, 22000.0, 0.003717, 1e-3)],
)
def test_law_is_a_linear_pid_with_second_derivative(gains, K_p, K_i, K_d, precision):
    # e follows e1 = a t^2, so its derivative and integral are known; the plant of Eq 8 gives
    # e1'' = A21 e1 + A22 e2 + B2 u, solved for the u that the second derivative answers.
    T_s, samples, a, D_c = 1e-7, 20000, 1.0, gains["D_c"] * 1e6
    law = block(T_s, **gains, **WIDE)
    for k in range(samples + 1):
        t = k * T_s
        u = law.output(REST, REST, Estimate(a * t * t, 2 * a * t, 0.0))
        law.update()
    e1, e2, integral = a * t**2, 2 * a * t, a * t**3 / 3
    pid = 1e6 * (K_p * e1 + K_i * integral + K_d * e2)
    expected = -(pid + D_c * (A21 * e1 + A22 * e2)) / (1 + B2 * D_c)
    assert u == pytest.approx(expected, rel=precision)


def test_derivative_of_q_is_what_the_plant_does(simulate):
    # Eq 11 with eps = 0: q' = B2 u_3, and u_3 = -(P q + I int q + D_c q').
    gains = {"m": 3000.0, "P": 0.002, "I": 2.0, "D_c": 3e-7}
    T_s = 2e-8
    law = block(T_s, **gains, **WIDE)
    run = simulate(law, lambda t: REST, 2000, x0=(1e-6, 0.0))
    q = gains["m"] * run.x1 + run.x2
    q_dot = np.gradient(q, T_s)[1000]
    integral = T_s * np.sum(q[:1001])
    u_3 = -1e6 * (gains["P"] * q[1000] + gains["I"] * integral + gains["D_c"] * q_dot)
    assert q_dot / B2 == pytest.approx(u_3, rel=1e-3)


def test_integral_is_a_backward_rectangle():
    law = block(P=0.0, I=2.0, D_c=0.0, m=1000.0, **WIDE)
    at = [Estimate(x1 * 1e-6, 0.0, 0.0) for x1 in (1.0, -3.0, 0.5)]
    without = [-A21 * x.x1 / B2 for x in at]
    integral = -2.0 * T_S * np.cumsum([1000.0, -3000.0, 500.0])
    got = []
    for x in at:
        got.append(law.output(REST, REST, x))
        law.update()
    assert got == pytest.approx(np.add(without, integral), rel=1e-12)


def test_integral_waits_while_the_command_is_limited():
    law = block(P=0.01, I=6.0, m=5000.0, voltage_min=0.0, voltage_max=90.0)
    law.output(REST, REST, Estimate(-20e-6, 0.0, 0.0))
    law.update()
    assert law.s.v_I == 0.0


def test_integral_moves_while_the_command_is_within_limits():
    law = block(P=0.01, I=6.0, m=5000.0, voltage_min=-110.0, voltage_max=110.0)
    law.output(REST, REST, Estimate(-1e-6, 0.0, 0.0))
    law.update()
    assert law.s.v_I == pytest.approx(-6.0 * T_S * 5000.0, rel=1e-12)


def test_feedforward_makes_the_error_vanish_on_the_nominal_plant(simulate, sine):
    w = sine(100.0)
    T_s = 1e-6
    start = w(0.0)
    run = simulate(block(T_s, **SET_1, **WIDE), w, 5000, x0=(start.w, start.w_dot))
    w_k = np.array([w(k * T_s).w for k in range(5000)])
    lag = 100.0 * 2 * math.pi * 5e-6 * T_s / 2  # a held voltage is half a sample late
    assert np.abs(run.x1 - w_k).max() < lag


def test_eps_compensation_cancels_a_known_eps(simulate):
    law = block(eps_compensation=True, **{**SET_1, "I": 0.0}, **WIDE)
    level = Reference(2e-6, 0.0, 0.0)
    run = simulate(law, lambda t: level, 10, x0=(2e-6, 0.0), eps=7.0, tell=True)
    assert np.abs(run.x1 - 2e-6).max() < 1e-15


def test_a_step_that_saturates_does_not_lock_the_loop(simulate):
    # Without the end of patience the integral is caught and y stays 2.2 um off for ever.
    low, high = Reference(0.0, 0.0, 0.0), Reference(10e-6, 0.0, 0.0)
    limits = {"voltage_min": 0.0, "voltage_max": 90.0}
    run = simulate(
        block(**limits),
        lambda t: low if t < 0.01 else high,
        3200,
        limits=(0.0, 90.0),
        eps=-4.0,
    )
    assert abs(run.x1[-1] - 10e-6) < 1e-10


@given(
    limits=st.tuples(st.floats(-20.0, 0.0), st.floats(60.0, 110.0)),
    eps=st.floats(-8.0, 8.0),
    beyond=st.floats(-30e-6, 30e-6),
    m=st.floats(2500.0, 12000.0),  # below, P is so high that the sampled loop is unstable
    Pm=st.floats(5.0, 12.0),
    I=st.floats(1.0, 10.0),
)
@settings(max_examples=15, deadline=None)
def test_saturation_in_and_out_recovers(simulate, limits, eps, beyond, m, Pm, I):  # noqa: E741
    low, high = limits
    law = block(m=m, P=Pm / m, I=I, voltage_min=low, voltage_max=high)
    w_end = 0.142e-6 * (0.5 * (low + high) + eps)
    levels = [Reference(w, 0.0, 0.0) for w in (w_end, beyond, w_end)]
    run = simulate(law, lambda t: levels[min(int(t / 0.01), 2)], 3000, limits=limits, eps=eps)
    assert abs(run.x1[-1] - w_end) < 1e-9


def live(params):
    return [n for n, s in specs(params).items() if not s.fixed and "preview" not in n]


def test_fig_8_from_5_um(simulate):
    run = simulate(block(**SET_1, **WIDE), lambda t: REST, 4000, x0=(5e-6, 0.0))
    nm = run.x1 * 1e9
    assert (np.abs(nm) > 100.0).nonzero()[0][-1] + 1 == 37  # 2 % from 1.85 ms on
    assert (np.abs(nm) > 10.0).nonzero()[0][-1] + 1 == 55  # 2.75 ms
    assert nm.min() == pytest.approx(-5.80, abs=0.01)
    assert nm.argmin() == 110  # 5.5 ms
    assert nm[200] == pytest.approx(-5.46, abs=0.01)  # 10 ms; tells the rule of the integral
    assert (np.abs(nm) > 1.0).nonzero()[0][-1] * T_S == pytest.approx(0.123, abs=0.0005)


@pytest.mark.parametrize(
    ("gains", "hysteresis", "expected", "precision"),
    [(SET_2, True, 13.85, 0.01), (SET_2, False, 0.12, 0.005), (SET_1, True, 438.5, 1.0)],
)
def test_fig_9_rms_at_10_hz(simulate, sine, gains, hysteresis, expected, precision):
    w = sine(10.0)
    run = simulate(block(**gains, **WIDE), w, 6000, hysteresis=hysteresis)
    w_k = np.array([w(k * T_S).w for k in range(6000)])
    assert rms_nm((run.x1 - w_k)[4000:]) == pytest.approx(expected, abs=precision)


def test_constant_eps_leaves_no_steady_error(simulate):
    level = Reference(3e-6, 0.0, 0.0)
    run = simulate(block(**WIDE), lambda t: level, 2000, eps=6.0)
    assert abs(run.x1[-1] - 3e-6) < 1e-12
