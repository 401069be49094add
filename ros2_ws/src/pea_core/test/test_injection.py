"""What is injected is what was asked for: lines, peak, softness, limits, derivatives."""

import re

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from pea_core import injection
from pea_core.injection import InjectParams, ahead_of, crest, design, plan, signal, wave
from pea_core.params import ParameterError
from pea_core.signals import Reference

T_S = 50e-6
LIMITS = (-20.0, 110.0, 0.0, 0.142)


def made(**values):
    return design(InjectParams(**{"where": "voltage", **values}), *LIMITS, 0.0, T_S)


@pytest.mark.parametrize("kind", injection.KINDS)
def test_measured_periods_hold_the_lines_and_nothing_else(kind):
    params = InjectParams("voltage", kind, from_hz=50.0, to_hz=900.0, lines=6, period=0.02)
    d = wave(params, T_S)[:, 0]
    found = plan(params, T_S)
    spectrum = np.abs(np.fft.rfft(found.measured(d), axis=0)[:, 0])  # (lines, blocks, periods)
    assert spectrum.shape[1:] == (found.blocks, params.periods)
    for block, lines in enumerate(found.lines):
        asked = np.zeros(spectrum.shape[0], bool)
        asked[lines] = True
        assert spectrum[asked, block].min() > 1.0
        assert spectrum[~asked, block].max() < 1e-9 * spectrum[:, block].max()
        assert np.ptp(spectrum[:, block], axis=1).max() < 1e-9


def test_multisines_have_lines_of_one_size_and_other_phases_in_each_block():
    found = plan(InjectParams("voltage", seed=3), T_S)
    d = wave(InjectParams("voltage", seed=3), T_S)[:, 0]
    lines = np.fft.rfft(found.measured(d)[:, 0, :, 0], axis=0)[found.lines[0]]
    assert np.ptp(np.abs(lines)) < 1e-9 * np.abs(lines).max()
    assert np.abs(np.diff(np.angle(lines), axis=1)).mean() > 0.5


def test_crest_factor_is_lowered():
    rng = np.random.default_rng(1)
    lines = np.arange(1, 200)
    random = np.zeros(1001, complex)
    random[lines] = np.exp(2j * np.pi * rng.random(199))
    lowered = np.zeros(1001, complex)
    lowered[lines] = np.exp(1j * injection.phases(2000, lines, np.random.default_rng(1)))
    assert crest(np.fft.irfft(random, 2000)) > 2.8
    assert crest(np.fft.irfft(lowered, 2000)) < 2.0


@pytest.mark.parametrize("kind", injection.KINDS)
def test_it_begins_and_ends_softly_and_its_largest_value_is_the_amplitude(kind):
    c = made(kind=kind, amplitude_V=0.7, to_hz=500.0, lines=9)
    d = c.wave[:, 0]
    assert np.abs(d).max() == pytest.approx(0.7)
    assert d[0] == 0.0
    assert abs(d[-1]) < 1e-12
    inner = np.abs(np.diff(d)).max()
    assert np.abs(d[:20]).max() < 0.01
    assert abs(d[0]) <= inner
    assert abs(d[-1]) <= inner


@pytest.mark.parametrize("kind", injection.KINDS)
def test_derivatives_are_those_of_the_signal(kind):
    d = wave(InjectParams("reference", kind, to_hz=300.0, lines=5), T_S)
    t = np.arange(len(d)) * T_S
    spline = CubicSpline(t, d[:, 0])
    inside = slice(50, -50)
    for order in (1, 2):
        told, other = d[inside, order], spline(t[inside], order)
        assert np.abs(told - other).max() < 2e-3 * np.abs(other).max()


def test_a_preview_sees_the_signal_ahead():
    params = InjectParams("reference", to_hz=500.0)
    c = design(params, *LIMITS, 1.5, T_S)
    zero = Reference(0.0, 0.0, 0.0)
    d = wave(params, T_S)[:, 0] * params.amplitude_um * 1e-6
    between = CubicSpline(np.arange(len(d)), d)
    for k in (3000, 7777):
        assert ahead_of(c, k, zero).w == pytest.approx(between(k + 1.5), abs=1e-12)


def test_it_is_cut_where_the_voltage_would_leave_the_range():
    c = made(amplitude_V=1.0)
    k = int(np.argmax(c.wave[:, 0]))
    assert injection.at_voltage(c, k, 109.5) == pytest.approx(0.5)
    assert injection.at_voltage(c, k, 115.0) == 0.0
    assert injection.at_voltage(c, k, 50.0) == pytest.approx(1.0)


def test_off_takes_any_values():
    assert design(InjectParams(to_hz=1e6, from_hz=1e6), *LIMITS, 0.0, T_S).where == injection.OFF


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"to_hz": 10_000.0}, "to_hz = 10000: must be below half the sample rate, 10000 Hz"),
        ({"from_hz": 11.0, "to_hz": 12.0}, "period = 0.1 s: holds no line between 11 and 12 Hz"),
        ({"amplitude_V": 70.0}, "amplitude_V = 70: must be at most 65 V"),
        ({"periods": 10_000, "period": 1.0}, "at most 209.7 s"),
    ],
)
def test_what_cannot_be_is_refused(values, words):
    with pytest.raises(ParameterError, match=re.escape(words)):
        made(**values)


def test_a_slope_beyond_the_slew_limit_is_refused():
    with pytest.raises(ParameterError, match="amplitude_V = 1: would change the voltage by"):
        design(InjectParams("voltage", amplitude_V=1.0), -20.0, 110.0, 500.0, 0.142, 0.0, T_S)


def test_a_band_upside_down_is_refused():
    with pytest.raises(ParameterError, match=r"from_hz = 20: must not be above to_hz \(10 Hz\)"):
        InjectParams("voltage", from_hz=20.0, to_hz=10.0)


def test_a_short_record_is_refused():
    found = plan(InjectParams("voltage"), T_S)
    with pytest.raises(ParameterError, match="100 samples: the injection needs"):
        found.measured(np.zeros(100))


def test_signal_counts_from_switching_on():
    from types import SimpleNamespace

    limits = {"voltage_min": -20.0, "voltage_max": 110.0, "slew_rate": 0.0, "K": 0.142}
    law = SimpleNamespace(inject=InjectParams("voltage", wait=0.01), preview=0.0, **limits)
    found, d = signal(law, T_S)
    assert found.wait == 200
    assert len(d) == found.samples
    assert not d[:201].any()
    assert d[205] != 0.0
