import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.polynomial import Polynomial

from pea_core.signals import SAMPLE, TRUTH, Estimate, Measurement, Reference, between

T_s = 50e-6


def sine(t: float, omega: float = 1.0) -> Reference:
    """Amplitude 1, exact derivatives."""
    s, c = math.sin(omega * t), math.cos(omega * t)
    return Reference(s, omega * c, -omega * omega * s)


def test_one_sample_is_reference_measurement_estimate_and_command_in_this_order():
    names = [*Reference._fields, *Measurement._fields, *[f + "_hat" for f in Estimate._fields]]
    assert list(SAMPLE.names) == [*names, "u"]


@pytest.mark.parametrize("layout", [SAMPLE, TRUTH])
def test_samples_are_little_endian_float64_without_gaps(layout):
    assert all(layout[name] == np.dtype("<f8") for name in layout.names)
    assert layout.itemsize == 8 * len(layout.names)


def test_start_of_the_interval_is_kept_bit_for_bit():
    a, b = sine(0.3), sine(0.4)
    assert between(a, b, 0.0, 0.1) == a


@given(
    coefficients=st.lists(st.floats(-10.0, 10.0), min_size=5, max_size=5),
    theta=st.floats(0.0, 1.0),
    t_a=st.floats(-2.0, 2.0),
    h=st.floats(0.1, 2.0),
)
@settings(deadline=None)
def test_polynomial_of_degree_4_is_reproduced(coefficients, theta, t_a, h):
    w = Polynomial(coefficients)
    parts = (w, w.deriv(1), w.deriv(2))

    def at(t):
        return Reference(*(float(part(t)) for part in parts))

    got = between(at(t_a), at(t_a + h), theta, h)
    assert got == pytest.approx(at(t_a + theta * h), rel=1e-9, abs=1e-8)


def test_polynomial_of_degree_5_is_not_so_the_one_before_can_fail():
    got = between(Reference(0.0, 0.0, 0.0), Reference(1.0, 5.0, 20.0), 0.5, 1.0)
    assert abs(got.w - 0.5**5) > 0.01


@pytest.mark.parametrize(("part", "order"), [("w", 5), ("w_dot", 4), ("w_ddot", 3)])
def test_order_of_accuracy(part, order):
    def worst(h):
        thetas = np.linspace(0.05, 0.95, 19)
        points = [(between(sine(0.7), sine(0.7 + h), x, h), sine(0.7 + x * h)) for x in thetas]
        return max(abs(getattr(got, part) - getattr(exact, part)) for got, exact in points)

    assert math.log2(worst(0.1) / worst(0.05)) == pytest.approx(order, abs=0.1)


@pytest.mark.parametrize("theta", [0.25, 0.5, 0.9, 1.0])
def test_error_on_a_sine_is_within_the_bound_of_cubic_interpolation(theta):
    omega = 2.0 * math.pi * 150.0  # for 5 um at 20 kHz the bound is 1.6 fm
    a, b, exact = (sine(t, omega) for t in (7 * T_s, 8 * T_s, (7 + theta) * T_s))
    got = between(a, b, theta, T_s)
    assert abs(got.w - exact.w) < (omega * T_s) ** 5 / 720.0
    assert abs(got.w_dot - exact.w_dot) < omega * (omega * T_s) ** 4 / 384.0


@given(theta=st.floats(0.0, 1.0))
@settings(deadline=None)
def test_velocity_and_acceleration_are_the_derivatives_of_what_is_given(theta):
    a, b, h, d = sine(0.2), sine(1.2), 1.0, 1e-5
    before, got, after = (between(a, b, x, h) for x in (theta - d, theta, theta + d))
    assert (after.w - before.w) / (2 * d) == pytest.approx(got.w_dot, abs=1e-8)
    assert (after.w_dot - before.w_dot) / (2 * d) == pytest.approx(got.w_ddot, abs=1e-8)


def test_end_of_the_interval_meets_velocity_and_acceleration():
    b = sine(1.2)
    got = between(sine(0.2), b, 1.0, 1.0)
    assert (got.w_dot, got.w_ddot) == pytest.approx((b.w_dot, b.w_ddot), abs=1e-14)


@pytest.mark.parametrize("theta", [0.0, 0.5, 0.999])
def test_step_stays_at_the_level_before_it_comes(theta):
    got = between(Reference(1.0, 0.0, 0.0), Reference(6.0, 0.0, 0.0), theta, T_s)
    assert got == Reference(1.0, 0.0, 0.0)
