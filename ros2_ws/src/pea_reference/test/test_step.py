"""The step reference, raw and shaped."""

import numpy as np
import pytest
from scipy.signal import lti
from scipy.signal import step as step_response

from pea_core.block import Signal
from pea_core.params import build
from pea_core.signals import Reference
from pea_reference.model import step


def signal(T_s=50e-6, **values):
    return Signal(step, build(step.Params, values), T_s)


def test_raw_step_jumps_at_its_sample():
    raw = signal(amplitude_um=5.0, offset_um=1.0, time=0.01)
    assert raw.at(199) == Reference(1e-6, 0.0, 0.0)
    assert raw.at(200) == Reference(1e-6 + 5.0 * 1e-6, 0.0, 0.0)


@pytest.mark.parametrize("shape", ["minimum_jerk", "filtered"])
@pytest.mark.parametrize("k", [1010, 2500, 5000, 9000])
def test_derivatives_of_shaped_steps(shape, k, differences_agree):
    shaped = signal(1e-6, shape=shape, rise_time=0.01, time=0.001)
    differences_agree(shaped, k)


@pytest.mark.parametrize(("shape", "end"), [("minimum_jerk", 11000), ("filtered", 1000)])
def test_shaped_steps_are_continuous_at_joints(shape, end, is_continuous):
    shaped = signal(1e-6, shape=shape, rise_time=0.01, time=0.001, amplitude_um=-3.0)
    for k in (1000, end):
        is_continuous(shaped, k)
        assert abs(shaped.at(k - 1).w_ddot - shaped.at(k + 1).w_ddot) < 2e-3


def test_minimum_jerk_is_half_way_at_half_time_with_15_eighths_of_the_mean_speed():
    half = signal(1e-6, shape="minimum_jerk", rise_time=0.01, amplitude_um=4.0).at(5000)
    assert half.w == pytest.approx(2e-6, rel=1e-12)
    assert half.w_dot == pytest.approx(15 / 8 * 4e-6 / 0.01, rel=1e-12)
    assert half.w_ddot == pytest.approx(0.0, abs=1e-9)


def test_filtered_step_is_the_response_of_three_lags():
    shaped = signal(1e-5, shape="filtered", rise_time=0.01, amplitude_um=1.0)
    tau = shaped.c.tau
    k = np.arange(0, 4000, 100)
    _, expected = step_response(lti([1.0], np.poly([-1 / tau] * 3) * tau**3), T=k * 1e-5)
    np.testing.assert_allclose([shaped.at(int(i)).w * 1e6 for i in k], expected, atol=1e-9)


def test_rise_time_of_a_filtered_step_is_from_10_to_90_percent():
    shaped = signal(1e-6, shape="filtered", rise_time=0.01, amplitude_um=1.0)
    w = np.array([shaped.at(k).w for k in range(20000)]) * 1e6
    rise = np.flatnonzero(w >= 0.9)[0] - np.flatnonzero(w >= 0.1)[0]
    assert rise == pytest.approx(10000, abs=1)


@pytest.mark.parametrize("shape", step.SHAPES)
def test_step_ends_at_its_level(shape):
    assert signal(shape=shape, offset_um=1.0, amplitude_um=2.0).at(10**10).w == pytest.approx(
        3e-6, rel=1e-15
    )


def test_the_move_goes_to_the_last_level():
    params = build(step.Params, {"offset_um": 1.0, "amplitude_um": -3.0, "time": 0.25})
    assert step.move(params) == (0.25, pytest.approx(-2e-6))
