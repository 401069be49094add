"""PID against its closed form and scipy's filters."""

import numpy as np
import pytest
from scipy.signal import lfilter

from pea_controller.model import pid
from pea_core.block import Block
from pea_core.params import build
from pea_core.signals import Estimate, Reference

T_S = 50e-6
REST = Reference(0.0, 0.0, 0.0)
WIDE = {"voltage_min": -1e4, "voltage_max": 1e4}
GAINS = {"K_p": 1.5, "K_i": 4000.0, "K_d": 1e-3, "T_f": 2e-4}


def block(**values):
    return Block(pid, build(pid.Params, values), T_S)


def test_command_is_three_filters_of_the_error():
    e = np.random.default_rng(3).normal(size=300) * 1e-6
    law = block(**GAINS, **WIDE)
    got = []
    for e_k in e:
        got.append(law.output(REST, REST, Estimate(-e_k, 0.0, 0.0)))
        law.update()
    integral = lfilter([T_S], [1.0, -1.0], e)
    derivative = lfilter([1.0, -1.0], [2e-4 + T_S, -2e-4], e)
    expected = 1e6 * (1.5 * e + 4000.0 * integral + 1e-3 * derivative)
    np.testing.assert_allclose(got, expected, rtol=1e-9, atol=1e-12)


def test_derivative_of_a_ramp_is_its_slope():
    law = block(K_p=0.0, K_i=0.0, K_d=1e-3, T_f=2e-4, **WIDE)
    for k in range(200):
        u = law.output(REST, REST, Estimate(-1e-3 * k * T_S, 0.0, 0.0))
        law.update()
    assert u == pytest.approx(1e-3 * 1e6 * 1e-3, rel=1e-9)


def test_derivative_without_filter_is_a_backward_difference():
    law = block(K_p=0.0, K_i=0.0, K_d=1e-3, T_f=0.0, **WIDE)
    law.output(REST, REST, Estimate(-1e-6, 0.0, 0.0))
    law.update()
    u = law.output(REST, REST, Estimate(-3e-6, 0.0, 0.0))
    assert u == pytest.approx(1e-3 * 2.0 / T_S, rel=1e-12)


def test_integral_waits_while_the_command_is_limited():
    law = block(**GAINS, voltage_min=-5.0, voltage_max=5.0)
    law.output(REST, REST, Estimate(-10e-6, 0.0, 0.0))
    law.update()
    assert law.s.v_I == 0.0


def test_an_integral_caught_beyond_the_limit_leads_back(simulate):
    # eps vanishes and w rises at once: what the integral holds alone is then above the limit.
    limits = {"voltage_min": 0.0, "voltage_max": 110.0}
    law = block(**limits)
    before, after = Reference(9e-6, 0.0, 0.0), Reference(12e-6, 0.0, 0.0)
    run = simulate(
        law,
        lambda t: before if t < 0.05 else after,
        5000,
        eps=lambda k: -40.0 if k < 1000 else 0.0,
        limits=(0.0, 110.0),
    )
    assert run.x1[990] == pytest.approx(9e-6, abs=1e-9)
    assert run.x1[-1] == pytest.approx(12e-6, abs=1e-9)


def test_constant_eps_leaves_no_steady_error(simulate):
    level = Reference(3e-6, 0.0, 0.0)
    run = simulate(block(**WIDE), lambda t: level, 4000, eps=6.0)
    assert abs(run.x1[-1] - 3e-6) < 1e-12


def test_eps_compensation_cancels_a_known_eps(simulate):
    level = Reference(2e-6, 0.0, 0.0)
    law = block(K_i=0.0, eps_compensation=True, **WIDE)
    run = simulate(law, lambda t: level, 10, x0=(2e-6, 0.0), eps=7.0, tell=True)
    assert np.abs(run.x1 - 2e-6).max() < 1e-15
