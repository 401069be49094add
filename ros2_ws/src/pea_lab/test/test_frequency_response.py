"""Measuring a frequency response: against exact sampled systems and closed forms."""

import math

import numpy as np
import pytest
from scipy.signal import cont2discrete, lfilter

from pea_core.nominal import NominalModel
from pea_experiment import experiments
from pea_lab import frequency_response
from pea_lab.frequency_response import Response

T_S = 50e-6
NOMINAL = NominalModel()
LINES = np.array([10.0, 20.0, 500.0, 730.0, 740.0, 860.0, 870.0, 1500.0, 4000.0])


def excited(model, periods=4):
    """u and y of an exactly sampled model, whole periods of 0.1 s after the transient."""
    s = -model.A22, -model.A21
    b, a, _ = cont2discrete(([model.B2], [1.0, *s]), T_S)
    t = np.arange(2000 * periods) * T_S
    u = sum(np.sin(2 * math.pi * f * t + i * i) for i, f in enumerate(LINES))
    return u[-4000:], lfilter(b[0], a, u)[-4000:]


def test_the_hold_and_its_aliases_are_taken_out():
    u, y = excited(NOMINAL)
    found = frequency_response.measured(y, u, LINES, T_S, NOMINAL).V
    s = 2j * math.pi * LINES
    exact = NOMINAL.K * 1e-6 * 5450.0**2 / (s * s + 2 * 0.82 * 5450.0 * s + 5450.0**2)
    assert found == pytest.approx(exact, rel=1e-6)


def test_another_actuator_shows_up():
    other = NominalModel(omega_n=5000.0, zeta=0.7, K=0.12)
    u, y = excited(other)
    found = frequency_response.measured(y, u, LINES, T_S, NOMINAL).V
    assert found[:-2] == pytest.approx(frequency_response.model(other, LINES)[:-2], rel=2e-4)


def test_points_of_the_nominal_model():
    f = np.arange(10.0, 2000.0, 10.0)
    found = frequency_response.figures(Response(f, frequency_response.model(NOMINAL, f)), NOMINAL)
    r = math.sqrt((2 - 4 * 0.82**2) ** 2 / 4 + 1) + (2 - 4 * 0.82**2) / 2  # |V| = K/sqrt(2)
    assert found["minus_3_dB_hz"] == pytest.approx(5450 * math.sqrt(r) / (2 * math.pi), abs=0.05)
    assert found["minus_90_degrees_hz"] == pytest.approx(5450 / (2 * math.pi), abs=0.01)
    assert found["gain_error_dB"] == pytest.approx(0.0, abs=1e-9)
    assert found["phase_error_deg"] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(
    "lines", [(10.0, 100.0, 500.0, 1500.0), (50.0, 200.0, 2000.0), (300.0, 1000.0)]
)
@pytest.mark.parametrize("model", [NOMINAL, NominalModel(zeta=0.4, omega_n=4000.0, K=0.12)])
def test_a_few_lines_give_the_same_points_as_many(lines, model):
    def points(f):
        found = frequency_response.figures(Response(f, frequency_response.model(model, f)), NOMINAL)
        return found["minus_3_dB_hz"], found["minus_90_degrees_hz"]

    assert points(np.array(lines)) == pytest.approx(points(np.arange(10.0, 3000.0, 1.0)), abs=1e-6)


def test_a_gain_that_never_falls_has_no_points():
    flat = Response(LINES, np.full(LINES.size, 0.142e-6 + 0j))
    found = frequency_response.figures(flat, NOMINAL)
    assert found["minus_3_dB_hz"] is None
    assert found["minus_90_degrees_hz"] is None


def test_fig5_comes_out_of_the_simulated_actuator():
    experiment = experiments.load("fig5_frequency_response", duration=0.3)
    loop = experiment.loop()
    samples = np.concatenate([loop.run(1000) for _ in range(6)])
    response = frequency_response.of_run(experiment, samples)
    assert response is not None
    found = frequency_response.figures(response, experiment.nominal)
    assert found["minus_3_dB_hz"] == pytest.approx(732.4, abs=0.3)
    assert found["minus_90_degrees_hz"] == pytest.approx(867.4, abs=0.3)


@pytest.mark.parametrize("blocks", [[1], [1000, 1000]])
def test_a_run_of_one_period_or_less_measures_nothing(blocks):
    experiment = experiments.load("fig5_frequency_response", duration=sum(blocks) * 50e-6)
    loop = experiment.loop()
    samples = np.concatenate([loop.run(n) for n in blocks])
    assert frequency_response.of_run(experiment, samples) is None


def test_other_references_measure_nothing():
    experiment = experiments.load("fig9_hysteresis_10hz", duration=0.2)
    samples = experiment.loop().run(1000)
    assert frequency_response.of_run(experiment, samples) is None
