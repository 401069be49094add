"""Repetitive learning alone: its period, its filter and its fixed point."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pea_controller.model import repetitive
from pea_core.params import ParameterError
from pea_core.signals import Reference

T_S = 50e-6


def coefficients(rate=0.5, bandwidth_hz=5000.0, frequency_hz=0.0, period_max=0.1, lead=2):
    return repetitive.design(True, rate, bandwidth_hz, frequency_hz, period_max, lead, T_S)


def waves(*parts):
    """A sum of cosines: (Hz, m, phase)."""

    def w(k):
        at = [(2 * math.pi * f, a, 2 * math.pi * f * k * T_S + phase) for f, a, phase in parts]
        return Reference(
            sum(a * math.cos(x) for _, a, x in at),
            sum(-a * o * math.sin(x) for o, a, x in at),
            sum(-a * o * o * math.cos(x) for o, a, x in at),
        )

    return w


def run(c, w, samples, disturbance=lambda k: 0.0):
    """Residuals and corrections where the residual tells of d + c of `lead` samples before."""
    s, told, eps, corrections = repetitive.blank(c), [0.0] * c.lead, [], []
    for k in range(samples):
        correction = repetitive.correction(c, s)
        told.append(disturbance(k) + correction)
        eps.append(told.pop(0))
        corrections.append(correction)
        s = repetitive.learned(c, s, w(k), eps[-1])
    return np.array(eps), np.array(corrections), s


@settings(max_examples=25, deadline=None)
@given(f=st.floats(30.0, 400.0), phase=st.floats(0.0, 6.28), offset=st.floats(-1e-5, 1e-5))
def test_period_of_a_sine_is_found(f, phase, offset):
    c = coefficients()
    _, _, s = run(c, waves((f, 5e-6, phase), (0.0, offset, 0.0)), 2000)
    assert s.period.N * f * T_S == pytest.approx(1.0, abs=1e-5)


def test_period_of_a_sum_of_sines_is_that_of_the_sum():
    f = 171.3  # the minima lie anywhere between two samples
    _, _, s = run(
        coefficients(), waves((f, 4e-6, 0.3), (3 * f, 2e-6, 1.0), (5 * f, 1e-6, 2.0)), 4000
    )
    assert s.period.N * f * T_S == pytest.approx(1.0, abs=1e-7)


@pytest.mark.parametrize("f", [160.0, 150.0, 147.3])
def test_what_is_periodic_shrinks_by_one_minus_gamma_each_period(f):
    c = coefficients(rate=0.5, frequency_hz=f)
    N = 1 / (f * T_S)

    def disturbance(k):
        return 3.0 + 2.0 * math.cos(2 * math.pi * f * k * T_S)

    eps, corrections, _ = run(c, waves((f, 5e-6, 0.0)), 4000, disturbance)
    first = int(np.flatnonzero(corrections)[0]) + c.lead + math.ceil(N)  # it has faded in
    peaks = [np.abs(eps[first + round(i * N) : first + round((i + 1) * N)]).max() for i in range(5)]
    assert np.divide(peaks[1:], peaks[:-1]) == pytest.approx(0.5, abs=0.02)


def test_filter_passes_what_is_slow_and_half_at_its_bandwidth():
    Q = coefficients(bandwidth_hz=1000.0).Q
    i = np.arange(Q.size) - Q.size // 2

    def gain(f):
        return float(Q @ np.cos(2 * math.pi * f * i * T_S))

    assert gain(0.0) == pytest.approx(1.0)
    assert gain(1000.0) == pytest.approx(0.5, abs=1e-9)
    assert (Q[::-1] == Q).all()


def test_a_ring_is_read_between_its_samples_by_a_cubic():
    ring = np.array([0.1 * k**3 - k**2 + 3.0 for k in range(16)])
    assert repetitive.remembered(ring, 7.3) == pytest.approx(0.1 * 7.3**3 - 7.3**2 + 3.0)


@pytest.mark.parametrize(
    "w",
    [
        lambda k: Reference(5e-6, 0.0, 0.0),
        lambda k: Reference(k * 1e-9, 1e-9 / T_S, 0.0),
        waves((100.0, 5e-6, 0.0), (100.0 * math.sqrt(2.0), 5e-6, 0.0)),
    ],
    ids=["level", "ramp", "no common period"],
)
def test_without_period_nothing_is_corrected(w):
    _, corrections, _ = run(coefficients(), w, 4000, lambda k: math.cos(0.05 * k))
    assert not corrections.any()


def test_correction_ends_when_the_reference_changes():
    sine = waves((160.0, 5e-6, 0.0))
    slower = waves((100.0, 5e-6, 0.0))
    _, corrections, _ = run(
        coefficients(),
        lambda k: sine(k) if k < 2000 else slower(k - 2000),
        2100,
        lambda k: 1.0 + math.cos(2 * math.pi * 160.0 * k * T_S),
    )
    assert corrections[1990] != 0.0
    assert not corrections[2010:].any()


def test_learning_that_makes_things_worse_is_given_up():
    c = coefficients(rate=0.5, frequency_hz=200.0)
    s, told = repetitive.blank(c), [0.0] * 12
    w = waves((200.0, 5e-6, 0.0))
    for k in range(20000):
        # ten samples later than it was promised: at 1 kHz, the wrong sign
        told.append(math.cos(2 * math.pi * 1000.0 * k * T_S) + repetitive.correction(c, s))
        eps = told.pop(0)
        assert abs(eps) < 10.0
        s = repetitive.learned(c, s, w(k), eps)
    assert s.use.given_up
    assert repetitive.correction(c, s) == 0.0


@pytest.mark.parametrize("frequency_hz", [5.0, 4000.0])
def test_a_period_that_does_not_fit_is_refused(frequency_hz):
    with pytest.raises(ParameterError, match=r"learning_frequency_hz = .*: must be within"):
        coefficients(frequency_hz=frequency_hz)


@pytest.mark.parametrize(("bandwidth_hz", "period_max"), [(5000.0, 10.0), (0.1, 1e-3)])
def test_a_memory_without_measure_is_refused(bandwidth_hz, period_max):
    with pytest.raises(ParameterError, match=r"T_s = 1e-06 s: learning would keep 1e\+07 samples"):
        repetitive.design(True, 0.2, bandwidth_hz, 0.0, period_max, 2, 1e-6)


def test_off_needs_no_memory():
    c = repetitive.design(False, 0.2, 5000.0, 0.0, 1.0, 2, T_S)
    s = repetitive.blank(c)
    assert (s.w.size, s.raw.size, s.r.size) == (0, 0, 0)
    assert repetitive.learned(c, s, Reference(1.0, 0.0, 0.0), 1.0) is s


def test_compiled_learning_gives_the_same_bits(compiled):
    c = coefficients()
    s, fast = repetitive.blank(c), repetitive.blank(c)
    learned, correction = compiled(repetitive.learned), compiled(repetitive.correction)
    w = waves((160.0, 5e-6, 0.0))
    rng = np.random.default_rng(3)
    for k in range(1000):
        eps = float(rng.normal())
        assert correction(c, fast) == repetitive.correction(c, s)
        s, fast = repetitive.learned(c, s, w(k), eps), learned(c, fast, w(k), eps)
    assert repetitive.acts(c, s)
    assert (fast.period, fast.use) == (s.period, s.use)
    assert (fast.r == s.r).all()
