"""The sum of sines."""

import math

import numpy as np
import pytest

from pea_core.block import Signal
from pea_core.params import ParameterError, build
from pea_reference.model import multisine

LINES = [float(f) for f in range(20, 420, 20)]


def signal(T_s=1e-6, **values):
    return Signal(multisine, build(multisine.Params, values), T_s)


def test_spectrum_has_the_lines_asked_for():
    asked = {"frequencies_hz": [20.0, 60.0, 100.0], "amplitudes_um": [1.0, 0.5, 2.0]}
    several = signal(50e-6, phases="listed", phases_deg=[0.0, 30.0, -45.0], **asked)
    w = np.array([several.at(k).w for k in range(1000)]) * 1e6
    lines = 2 * np.fft.rfft(w)[[1, 3, 5]] / 1000
    np.testing.assert_allclose(np.abs(lines), [1.0, 0.5, 2.0], rtol=1e-9)
    np.testing.assert_allclose(np.degrees(np.angle(lines)) + 90, [0.0, 30.0, -45.0], atol=1e-6)


def test_mean_is_the_offset():
    several = signal(50e-6, frequencies_hz=LINES, offset_um=4.0)
    assert np.mean([several.at(k).w for k in range(1000)]) == pytest.approx(4e-6, rel=1e-9)


def test_schroeder_phases_of_equal_lines_are_quadratic():
    i = np.arange(8)
    got = multisine.schroeder(np.ones(8))
    turns = (got + np.pi * i * (i + 1) / 8) / (2 * np.pi)
    np.testing.assert_allclose(turns, np.round(turns), atol=1e-12)


def test_schroeder_phases_keep_the_peak_low():
    def peak(phases):
        several = signal(50e-6, frequencies_hz=LINES, offset_um=0.0, phases=phases)
        w = np.array([several.at(k).w for k in range(1000)])
        return np.abs(w).max() / np.sqrt(np.mean(w**2))

    assert peak("schroeder") < 2.0
    assert peak("listed") > 4.0


@pytest.mark.parametrize("k", [10, 1234, 40000])
def test_derivatives(k, differences_agree):
    differences_agree(signal(frequencies_hz=LINES, amplitudes_um=[0.2]), k)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"amplitudes_um": [1.0, 2.0]}, "amplitudes_um has 2 values"),
        ({"phases_deg": [1.0, 2.0]}, "phases_deg has 2 values"),
        ({"frequencies_hz": []}, "frequencies_hz is empty"),
        (
            {"frequencies_hz": [10.0, 6e4]},
            r"frequencies_hz\[1\] = 60000: must be below half the sample rate",
        ),
    ],
)
def test_what_cannot_be_is_refused(values, words):
    with pytest.raises(ParameterError, match=words):
        signal(1e-5, **values)


def test_no_amplitude_at_all_is_a_constant():
    assert signal(amplitudes_um=[0.0]).at(77).w == pytest.approx(5e-6)
    assert math.isfinite(signal(amplitudes_um=[0.0]).at(77).w_ddot)


@pytest.mark.parametrize(
    ("frequencies", "period"),
    [([20.0, 30.0, 50.0], 0.1), ([7.0], 1 / 7), ([0.1, 0.25], 20.0), ([1 / 3, 1 / 2], 6.0)],
)
def test_it_repeats_itself_with_the_common_period(frequencies, period):
    params = build(multisine.Params, {"frequencies_hz": frequencies})
    ((start, end, found),) = multisine.segments(params)
    assert (start, end) == (0.0, math.inf)
    assert found == pytest.approx(period, rel=1e-12)


def test_frequencies_without_a_common_period_never_repeat():
    params = build(multisine.Params, {"frequencies_hz": [1.0, math.sqrt(2.0)]})
    assert multisine.segments(params) == ()
