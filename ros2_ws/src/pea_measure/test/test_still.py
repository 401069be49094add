"""Noise figures against the written definition of the Allan deviation and closed forms."""

import numpy as np
import pytest

from pea_core.params import ParameterError
from pea_measure import still

T_S = 1e-3


@pytest.fixture(scope="module")
def white():
    return np.random.default_rng(4).standard_normal(60_000) * 2e-9


def test_allan_deviation_is_that_of_its_definition(white):
    """IEEE Std 1139, sample by sample: half the mean square of the step between two means."""
    y = (white + np.cumsum(white) * 0.01)[:400]
    tau, found = still.allan(y, T_S)
    for t, deviation in zip(tau, found):
        m = round(t / T_S)
        steps = [
            y[k + m : k + 2 * m].mean() - y[k : k + m].mean() for k in range(len(y) - 2 * m + 1)
        ]
        assert deviation == pytest.approx(np.sqrt(0.5 * np.mean(np.square(steps))), rel=1e-9)


def test_allan_deviation_of_a_ramp_is_its_slope_times_tau_over_root_two():
    tau, found = still.allan(3e-9 * np.arange(2000) * T_S, T_S)
    np.testing.assert_allclose(found, 3e-9 * tau / np.sqrt(2.0), rtol=1e-6)


def test_white_noise_has_a_flat_density_and_falls_with_the_root_of_time(white):
    found = still.noise(white, T_S)
    assert np.median(found.density) == pytest.approx(2e-9 * np.sqrt(2.0 * T_S), rel=0.08)
    assert found.cumulative[-1] == pytest.approx(2e-9, rel=0.03)
    assert found.rms == pytest.approx(2e-9, rel=0.01)
    i = int(np.argmin(np.abs(found.tau - 0.1)))
    assert found.allan[i] == pytest.approx(2e-9 / np.sqrt(found.tau[i] / T_S), rel=0.1)


def test_resolution_of_white_noise_is_that_of_a_first_order_filter(white):
    """A first-order filter has the noise bandwidth pi/2 B."""
    found = still.noise(white, T_S)
    B = 10.0
    exact = 2e-9 * np.sqrt(2.0 * T_S) * np.sqrt(np.pi / 2.0 * B)
    assert still.rms_within(found, B) == pytest.approx(exact, rel=0.1)
    assert still.resolution(found, B) == pytest.approx(6.6 * still.rms_within(found, B))


def test_drift_is_told_apart(white):
    t = np.arange(len(white)) * T_S
    found = still.noise(white + 3e-9 * t, T_S)
    assert found.drift == pytest.approx(3e-9, rel=0.02)
    assert found.rms == pytest.approx(2e-9, rel=0.01)


def test_too_few_samples_are_refused():
    with pytest.raises(ParameterError, match="100 samples are too few for noise: record 256"):
        still.noise(np.zeros(100), T_S)
