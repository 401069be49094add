"""The Bouc-Wen benchmark: another solver's data, its parameters found, other data predicted."""

import numpy as np
import pytest
from scipy.integrate import odeint

from pea_core.params import ParameterError
from pea_identify import excitation, oscillator

TRUE = oscillator.Oscillator(2.0, 10.0, 5e4, 5e4, 1e3, 0.8, -1.1)
T_s = 1.0 / 750.0


def multisine(seed, N, rms=50.0):
    """The benchmark's test signal: 5 to 150 Hz, 50 N rms, random phases."""
    lines = excitation.lines_between(5.0, 150.0, N, T_s)
    return excitation.multisine(N, lines, rms, np.random.default_rng(seed))


def solved(u):
    """y by a solver with step control, of the force between the samples by its spectrum."""
    fine = 64
    force = np.fft.irfft(np.fft.rfft(u), len(u) * fine) * fine
    grid = np.arange(len(force)) * T_s / fine
    m, c, k, alpha, beta, gamma, delta, _ = TRUE

    def rate(x, t):
        y, v, z = x
        i = min(int(t / T_s * fine), len(force) - 2)
        f = force[i] + (t - grid[i]) / T_s * fine * (force[i + 1] - force[i])
        dz = alpha * v - beta * (gamma * abs(v) * z + delta * v * abs(z))
        return v, (f - c * v - k * y - z) / m, dz

    t = np.arange(len(u)) * T_s
    return odeint(rate, np.zeros(3), t, rtol=1e-8, atol=1e-11, mxstep=5000)[:, 0]


def decibels(error):
    return 20.0 * np.log10(np.sqrt(np.mean(error**2)))


@pytest.fixture(scope="module")
def data():
    """Made at ten times the steps that a fit takes; the first test is of another solver."""
    u, other = multisine(1, 4096), multisine(2, 4096)
    y, there = (oscillator.simulate(TRUE, x, T_s, steps=200) for x in (u, other))
    return u, y, other, there


def test_simulation_is_that_of_another_solver():
    u = multisine(5, 512)
    assert decibels(oscillator.simulate(TRUE, u, T_s) - solved(u)) < -130.0


def test_parameters_are_recovered_and_the_test_signal_is_simulated(data):
    u, y, other, there = data
    found = oscillator.fit(u, y, T_s, beta=1e3)
    for name in oscillator.FREE:
        assert getattr(found.values, name) == pytest.approx(getattr(TRUE, name), rel=1e-4)
    assert decibels(oscillator.simulate(found.values, other, T_s) - there) < -120.0
    assert "beta" in found.sentences[0]


def test_with_noise_it_is_as_good_as_the_noise_allows(data):
    u, y, other, there = data
    sigma = 0.01 * y.std()
    noisy = y + sigma * np.random.default_rng(3).standard_normal(len(y))
    found = oscillator.fit(u, noisy, T_s, beta=1e3)
    assert found.error == pytest.approx(sigma, rel=0.05)
    for name in oscillator.FREE:  # 99.7 % intervals, and the widths are of use
        apart = abs(getattr(found.values, name) - getattr(TRUE, name))
        assert apart < 1.5 * found.half_width_95[name] < 0.15 * abs(getattr(TRUE, name))
    left = oscillator.simulate(found.values, other, T_s) - there
    # six parameters from as many samples: sigma sqrt(6 / N) is what no fit can better on average
    assert np.sqrt(np.mean(left**2)) < 2.0 * sigma * np.sqrt(6 / len(y))


def test_data_of_no_oscillator_are_refused():
    u = multisine(1, 1024)
    with pytest.raises(ParameterError, match="no oscillator"):
        oscillator.fit(u, 1e-5 * u, T_s)
    with pytest.raises(ParameterError, match="frequencies are excited"):
        oscillator.fit(np.zeros(1024), np.zeros(1024), T_s)
