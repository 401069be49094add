"""The sine reference."""

import math

import pytest

from pea_core.block import Signal
from pea_core.params import ParameterError, build
from pea_reference.model import sine


def test_mean_amplitude_and_frequency_are_as_asked():
    signal = Signal(sine, sine.Params(amplitude_um=4.0, offset_um=5.0, frequency_hz=10.0), 50e-6)
    assert signal.at(0).w == pytest.approx(5e-6, abs=1e-18)
    assert signal.at(500).w == pytest.approx(9e-6, abs=1e-18)
    assert signal.at(1500).w == pytest.approx(1e-6, abs=1e-18)
    assert signal.at(0).w_dot == pytest.approx(4e-6 * 20.0 * math.pi)


def test_phase_of_minus_90_degrees_starts_at_rest_at_the_lowest_point():
    signal = Signal(sine, sine.Params(phase_deg=-90.0), 50e-6)
    assert signal.at(0).w == pytest.approx(0.0, abs=1e-20)
    assert signal.at(0).w_dot == pytest.approx(0.0, abs=1e-18)


@pytest.mark.parametrize("k", [4, 100, 777, 1333])
def test_derivatives(k, differences_agree):
    differences_agree(Signal(sine, sine.Params(frequency_hz=150.0, phase_deg=30.0), 1e-6), k)


def test_frequency_beyond_half_the_sample_rate_is_refused():
    with pytest.raises(ParameterError, match=r"frequency_hz = 10000: must be below half the"):
        Signal(sine, sine.Params(frequency_hz=10000.0), 50e-6)


def test_it_repeats_itself_without_end():
    ((start, end, period),) = sine.segments(build(sine.Params, {"frequency_hz": 40.0}))
    assert (start, end, period) == (0.0, math.inf, 0.025)
