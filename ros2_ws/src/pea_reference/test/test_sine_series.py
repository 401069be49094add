"""The series of sines."""

import math

import pytest

from pea_core.block import Signal
from pea_core.params import ParameterError, build
from pea_reference.model import sine_series

FEW = {"frequencies_hz": [50.0, 100.0, 150.0], "periods": [1.0, 2.0, 3.0]}


def signal(T_s=1e-6, **values):
    return Signal(sine_series, build(sine_series.Params, {**FEW, **values}), T_s)


@pytest.mark.parametrize(
    ("t", "f", "start"),
    [(0.013, 50.0, 0.0), (0.021, 100.0, 0.02), (0.0433, 150.0, 0.04), (0.073, 50.0, 0.06)],
)
def test_each_frequency_has_its_turn_and_the_series_begins_again(t, f, start):
    expected = 5e-6 - 5e-6 * math.cos(2 * math.pi * f * (t - start))
    assert signal().at(round(t / 1e-6)).w == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("k", [5000, 25000, 35000, 50000, 70000])
def test_derivatives(k, differences_agree):
    differences_agree(signal(), k)


@pytest.mark.parametrize("k", [20000, 40000, 60000, 120000])
def test_joints_are_continuous_and_at_rest(k, is_continuous):
    is_continuous(signal(), k)
    assert signal().at(k).w_dot == pytest.approx(0.0, abs=1e-9)


def test_acceleration_changes_at_the_joint():
    before, after = signal().at(19999).w_ddot, signal().at(20001).w_ddot
    assert before == pytest.approx(5e-6 * (2 * math.pi * 50.0) ** 2, rel=1e-5)
    assert after == pytest.approx(5e-6 * (2 * math.pi * 100.0) ** 2, rel=1e-5)


def test_one_number_of_periods_serves_all():
    assert signal(periods=[2.0]).c.start[-1] == pytest.approx(2 / 50 + 2 / 100 + 2 / 150)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"periods": [1.0, 2.0]}, "periods has 2 values: give one, or one for each of the 3"),
        ({"periods": [1.5]}, r"periods\[0\] = 1.5: must be a whole number"),
        ({"frequencies_hz": []}, "frequencies_hz is empty"),
        ({"frequencies_hz": [1.0, 2.0, 6e4]}, r"frequencies_hz\[2\] = 60000: must be below half"),
    ],
)
def test_what_cannot_be_is_refused(values, words):
    with pytest.raises(ParameterError, match=words):
        signal(1e-5, **values)


def test_segments_are_the_sines_of_the_first_round():
    found = sine_series.segments(build(sine_series.Params, FEW))
    expected = [(0.0, 0.02, 0.02), (0.02, 0.04, 0.01), (0.04, 0.06, 1 / 150)]
    assert [tuple(row) for row in found] == [pytest.approx(row) for row in expected]


def test_each_segment_repeats_itself():
    for start, end, period in sine_series.segments(build(sine_series.Params, FEW)):
        one, other = (round(t / 1e-6) for t in (start + 1e-4, end - period + 1e-4))
        assert signal().at(one).w == pytest.approx(signal().at(other).w, abs=3e-9)
