"""Commands that did not act, and samples that were not recorded, spoil no frequency response."""

import numpy as np
import pytest

from pea_core.injection import InjectParams, plan, wave
from pea_core.signals import SAMPLE
from pea_measure import analysis
from pea_measure import loop_response as lr

T_S = 1e-3
PARAMS = InjectParams("voltage", from_hz=5.0, to_hz=400.0, realisations=3, period=0.2, periods=3)


def run(missed, delay):
    """A first-order stage whose commands act `delay` samples late; some never do."""
    rng = np.random.default_rng(1)
    d = np.append(wave(PARAMS, T_S)[:, 0], np.zeros(20))
    u = 10.0 + d
    acted = np.empty(len(u))
    lost = rng.random(len(u)) < missed
    for k in range(len(u)):
        before = u[0] if k == 0 else acted[k - 1]
        acted[k] = before if k < delay or lost[k] else u[k - delay]
    y = np.full(len(u), u[0] * 1e-7)
    for k in range(1, len(u)):
        y[k] = 0.8 * y[k - 1] + 0.2e-7 * acted[k - 1]
    samples = np.zeros(len(u), SAMPLE)
    samples["u"], samples["y"] = u, y
    samples["u_applied"] = np.append(acted[0], acted[:-1])
    return d, samples, int(lost.sum())


@pytest.mark.parametrize("delay", [0, 1, 3])
def test_a_stage_is_told_by_the_voltage_that_acted(delay):
    d, samples, lost = run(0.02, delay)
    acted, count = analysis.applied(samples)
    assert 0.5 * lost < count <= lost
    V, Y = lr.curves(plan(PARAMS, T_S), d, np.array([acted, samples["y"]]), T_S, 0)
    P = lr.quotient(Y, V)
    z = np.exp(2j * np.pi * P.f * T_S)
    error = np.abs(P.G * z**delay / (0.2e-7 / (z - 0.8)) - 1.0)
    assert np.median(error) < 0.02


@pytest.mark.parametrize("delay", [0, 2])
def test_where_every_command_acts_nothing_is_counted(delay):
    _, samples, _ = run(0.0, delay)
    acted, count = analysis.applied(samples)
    assert count == 0
    np.testing.assert_array_equal(acted[: -delay - 1], samples["u"][: -delay - 1])


def test_samples_stand_at_their_stamps():
    _, samples, _ = run(0.0, 0)
    stamps = np.arange(len(samples)) * 1_000_000
    keep = np.ones(len(samples), dtype=bool)
    keep[[0, 1, 100, 101, 500]] = False
    whole, lost = analysis.by_stamps(samples[keep], stamps[keep], 1_000_000)
    assert (len(whole), lost) == (len(samples), 5)
    np.testing.assert_array_equal(whole["u"][keep], samples["u"][keep])
    same, none = analysis.by_stamps(samples, stamps, 1_000_000)
    assert same is samples
    assert none == 0
