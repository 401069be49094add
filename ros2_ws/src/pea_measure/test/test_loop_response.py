"""Margins against python-control and closed forms; intervals that hold in a Monte Carlo."""

import math

import control
import numpy as np
import pytest

from pea_core.injection import InjectParams, Plan, plan, wave
from pea_core.params import ParameterError
from pea_measure import loop_response as lr

T_S = 50e-6
PARAMS = InjectParams("voltage", from_hz=10.0, to_hz=4000.0, realisations=4, periods=3)


def exact(f):
    """An integrating loop behind a resonance and a delay, as python-control sees it."""
    s = control.tf("s")
    wn = 5000.0
    L = 900.0 / s * wn**2 / (s**2 + 1.2 * wn * s + wn**2)
    omega = 2.0 * np.pi * np.asarray(f)
    return L(1j * omega) * np.exp(-1j * omega * 2.0 * T_S)


def test_margins_are_those_of_python_control():
    f = np.geomspace(2.0, 9000.0, 3000)
    L = exact(f)
    found = lr.margins(f, 1.0 / (1.0 + L), T_S)
    omega = 2.0 * np.pi * f
    gm, pm, sm, _, wc, _ = control.stability_margins(control.frd(L, omega))
    assert found["gain_upper"] == pytest.approx(gm, rel=2e-3)
    assert found["phase_deg"] == pytest.approx(pm, rel=2e-3)
    assert found["modulus"] == pytest.approx(sm, rel=2e-3)
    assert found["crossover_hz"] == pytest.approx(wc / 2.0 / math.pi, rel=2e-3)
    assert found["delay_samples"] == pytest.approx(math.radians(pm) / wc / T_S, rel=2e-3)


def test_margins_that_the_band_does_not_show_are_none():
    f = np.linspace(1.0, 10.0, 20)
    found = lr.margins(f, np.full(20, 0.99 + 0.0j), T_S)
    assert math.isnan(found["gain_upper"])
    assert math.isnan(found["phase_deg"])


def measured(rng, noise, params=PARAMS):
    """Curves of a discrete first-order system driven by the test signal, with white noise."""
    found = plan(params, T_S)
    d = wave(params, T_S)[:, 0]
    a = 0.9
    y = np.zeros(len(d))
    for k in range(1, len(d)):
        y[k] = a * y[k - 1] + (1.0 - a) * d[k - 1]
    z = np.exp(2j * np.pi * found.lines[0] / found.N)
    (curve,) = lr.curves(found, d, np.array([y + noise * rng.standard_normal(len(y))]), T_S, 0)
    return curve, (1.0 - a) / (z - a)


def test_a_known_system_is_within_its_intervals():
    rng = np.random.default_rng(7)
    inside = []
    for _ in range(5):
        curve, G = measured(rng, 0.05)
        inside.append(np.abs(curve.G - G) <= curve.radius)
    assert 0.92 <= np.mean(inside) <= 0.98


def test_without_noise_it_is_exact_and_coherent():
    curve, G = measured(np.random.default_rng(0), 0.0)
    np.testing.assert_allclose(curve.G, G, rtol=1e-6)
    assert np.nanmin(curve.coherence) > 1.0 - 1e-9


@pytest.mark.parametrize("kind", ["chirp", "stepped_sine"])
def test_other_signals_give_the_same_response(kind):
    params = InjectParams("voltage", kind, from_hz=100.0, to_hz=3000.0, lines=12, period=0.02)
    found = plan(params, T_S)
    d = wave(params, T_S)[:, 0]
    y = np.concatenate([[0.0], 0.5 * d[:-1]])  # half of it, a sample later
    (curve,) = lr.curves(found, d, np.array([y]), T_S, 0)
    np.testing.assert_allclose(
        curve.G, 0.5 * np.exp(-2j * np.pi * curve.f * T_S), rtol=1e-6, atol=1e-9
    )


def test_nonlinearity_is_told_apart_from_noise():
    found = plan(PARAMS, T_S)
    d = wave(PARAMS, T_S)[:, 0]
    (bent,) = lr.curves(found, d, np.array([d + 0.3 * d**3]), T_S, 0)
    (noisy,) = lr.curves(
        found, d, np.array([d + 0.05 * np.random.default_rng(1).standard_normal(len(d))]), T_S, 0
    )
    assert np.median(bent.nonlinear) > 100.0 * np.median(bent.noise)
    assert np.median(noisy.total) == pytest.approx(np.median(noisy.noise), rel=0.5)


def test_intervals_of_margins_hold_in_a_monte_carlo(monkeypatch):
    monkeypatch.setattr(lr, "DRAWS", 80)
    rng = np.random.default_rng(3)
    f = np.linspace(20.0, 4000.0, 200)
    S = 1.0 / (1.0 + exact(f))
    true = lr.margins(f, S, T_S)
    variance = np.full(200, 4e-5)
    covered = []
    for i in range(30):
        error = np.sqrt(variance / 2.0) * (rng.standard_normal(200) + 1j * rng.standard_normal(200))
        curve = lr.ResponseCurve(f, S + error, variance, variance, np.ones(200))
        told = lr.intervals(curve, T_S, seed=i)
        names = ("gain_upper", "phase_deg", "modulus")
        covered.append([told[n][1] <= true[n] <= told[n][2] for n in names])
    assert np.mean(covered, axis=0).min() >= 0.85


def test_nothing_bounds_a_loop_gain_where_the_sensitivity_may_be_none():
    none, one = np.zeros(2), np.ones(2)
    L = lr.open_loop(
        lr.ResponseCurve(one, np.array([0.1, 1.0]) + 0j, none + 0.01, none + 0.01, one)
    )
    assert np.isinf(L.radius[0])
    assert np.isfinite(L.radius[1])


def test_a_short_record_is_refused():
    found: Plan = plan(PARAMS, T_S)
    with pytest.raises(ParameterError, match="record for longer"):
        lr.curves(found, wave(PARAMS, T_S)[:, 0], np.zeros((1, 100)), T_S, 0)
