"""Learning on harmonics: its period, its filter, and what is left of a periodic unknown input."""

import math

import numpy as np
import pytest

from pea_controller.model import harmonics
from pea_core.params import ParameterError
from pea_core.signals import Reference

T_S = 50e-6
GAIN, LATE = 0.14e-6, 3


def respond(f, factors):
    z = np.exp(2j * np.pi * f * T_S)
    return np.array([gain * GAIN * z**-LATE for _, gain in factors])


def designed(method="repetitive", **values):
    return harmonics.design(
        harmonics.Params(method=method, period_max=0.02, bandwidth_hz=850.0, **values), respond, T_S
    )


def sine(f_start, f_end=None, samples=1):
    """5 - 5 cos, the frequency rising evenly."""
    slope = ((f_end or f_start) - f_start) / (samples * T_S)

    def w(k):
        t = k * T_S
        phase = 2 * math.pi * (f_start * t + 0.5 * slope * t * t)
        o = 2 * math.pi * (f_start + slope * t)
        return Reference(
            5e-6 * (1 - math.cos(phase)), 5e-6 * o * math.sin(phase), 5e-6 * o * o * math.cos(phase)
        )

    return w


def run(c, w, samples, unknown, gain=1.0):
    """Deviations and corrections of a stage without dynamics, `LATE` samples late."""
    s, way, e, corrections = harmonics.blank(c), [0.0] * LATE, [], []
    for k in range(samples):
        now = harmonics.correction(c, s)
        way.append(gain * GAIN * (unknown(w(k)) + now))
        e.append(way.pop(0))
        corrections.append(now)
        s = harmonics.learned(c, s, w(k), e[-1])
    return np.array(e), np.array(corrections), s


def unknown(W):
    """Harmonics of w up to the fourth (V)."""
    x = W.w / 5e-6 - 1.0
    return 2.0 * x**4 + 1.5 * x**3 + 1e-4 * W.w_dot * x / 5e-6


@pytest.mark.parametrize("method", ["repetitive", "iterative"])
@pytest.mark.parametrize(("f", "end", "gain"), [(201.37, 201.37, 0.6), (200.0, 201.0, 1.1)])
def test_what_repeats_is_gone_after_thirty_periods(method, f, end, gain):
    samples = 3500  # 35 periods
    e, _, s = run(designed(method, rate=0.5), sine(f, end, samples), samples, unknown, gain)
    assert s.period.N * end * T_S == pytest.approx(1.0, rel=1e-3)
    n = round(s.period.N)
    first = np.std(e[2 * n : 3 * n])
    assert np.std(e[-n:] - e[-n:].mean()) < 0.02 * first


def test_without_a_period_nothing_is_corrected():
    def w(k):
        a, b = 2 * math.pi * 100.0, 2 * math.pi * 141.42
        t = k * T_S
        return Reference(
            math.cos(a * t) + math.cos(b * t), -a * math.sin(a * t) - b * math.sin(b * t), 0.0
        )

    for reference in (w, lambda k: Reference(5e-6, 0.0, 0.0)):
        _, corrections, _ = run(designed(), reference, 3000, lambda W: 1.0)
        assert not corrections.any()


def test_it_ends_when_the_reference_changes():
    slow, fast = sine(100.0), sine(160.0)
    _, corrections, s = run(designed(), lambda k: slow(k) if k < 3000 else fast(k), 3030, unknown)
    assert corrections[2900:3000].any()
    assert not corrections[3025:].any()
    assert not s.a.any()


def test_it_is_given_up_where_the_stage_answers_with_the_other_sign():
    e, corrections, s = run(designed(), sine(100.0), 5000, unknown, -1.0)
    assert s.use.given_up
    assert corrections[-1] == 0.0
    assert np.abs(e[-200:]).max() == pytest.approx(np.abs(e[:200]).max(), rel=0.2)


def test_a_transient_is_not_learned():
    def fading(k):
        return 5.0 * math.exp(-k / 400.0)

    c, w = designed(), sine(100.0)
    s = harmonics.blank(c)
    for k in range(1200):
        s = harmonics.learned(c, s, w(k), GAIN * fading(k))
        assert harmonics.correction(c, s) == 0.0


def test_the_filter_is_zero_where_the_set_does_not_agree():
    H = np.array([[1.0, 1.0j, 1.0, 3.0], [1.1, -1.0j, -1.0, 2.0 + 1.0j]])
    F = harmonics.filter_of(H)
    assert F[1] == F[2] == 0.0
    assert ((F * H).real[:, [0, 3]] > 0.2).all()
    assert (np.abs(F * H) <= 1.0 + 1e-12).all()


@pytest.mark.parametrize("frequency_hz", [5e-324, 5.0, 4000.0])
def test_a_period_that_does_not_fit_is_refused(frequency_hz):
    with pytest.raises(ParameterError, match=r"learning.frequency_hz = .*: must be within"):
        designed(frequency_hz=frequency_hz)


def test_a_memory_without_measure_is_refused():
    with pytest.raises(ParameterError, match=r"learning.period_max = 10: .* at most 1e\+06"):
        harmonics.design(harmonics.Params(method="iterative", period_max=10.0), respond, 1e-6)


def test_off_needs_no_memory():
    s = harmonics.blank(designed("none"))
    assert (s.w.size, s.a.size) == (0, 0)
