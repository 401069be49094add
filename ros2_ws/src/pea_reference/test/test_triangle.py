"""The rounded triangle."""

import math

import numpy as np
import pytest

from pea_core.block import Signal
from pea_core.params import build
from pea_reference.model import triangle


def signal(T_s=1e-6, **values):
    return Signal(triangle, build(triangle.Params, {"frequency_hz": 100.0, **values}), T_s)


@pytest.mark.parametrize("rounding", [0.001, 0.1, 1.0])
def test_peaks_are_the_amplitude(rounding):
    one = signal(rounding=rounding, amplitude_um=4.0, offset_um=5.0)
    assert one.at(0).w == pytest.approx(1e-6, rel=1e-9)
    assert one.at(2500).w == pytest.approx(5e-6, rel=1e-9)
    assert one.at(5000).w == pytest.approx(9e-6, rel=1e-9)
    assert one.at(7500).w == pytest.approx(5e-6, rel=1e-9)


def test_slope_between_the_turns_is_constant():
    slopes = {signal(rounding=0.1).at(k).w_dot for k in (300, 2500, 4700)}
    assert len(slopes) == 1
    assert slopes.pop() == pytest.approx(4 * 5e-6 * 100.0 / (1 - 0.375 * 0.1), rel=1e-9)


@pytest.mark.parametrize("k", [50, 240, 260, 2500, 4900, 5100, 6000, 7500, 9800, 10100])
def test_derivatives(k, differences_agree):
    differences_agree(signal(rounding=0.1), k)


@pytest.mark.parametrize("k", [250, 2500, 4750, 5000, 5250, 7500, 9750, 10000])
def test_joints_are_continuous_to_the_second_derivative(k, is_continuous):
    one = signal(rounding=0.1)
    is_continuous(one, k)
    step = abs(one.at(k + 1).w_ddot - one.at(k - 1).w_ddot)
    peak = max(abs(one.at(i).w_ddot) for i in range(10000))
    assert step < 0.02 * peak


def test_it_repeats():
    a = np.array([signal().at(k) for k in range(0, 10000, 37)])
    b = np.array([signal().at(k + 10**7) for k in range(0, 10000, 37)])
    np.testing.assert_allclose(a[:, 0], b[:, 0], atol=1e-15)


def test_it_repeats_itself_without_end():
    ((start, end, period),) = triangle.segments(build(triangle.Params, {"frequency_hz": 40.0}))
    assert (start, end, period) == (0.0, math.inf, 0.025)
