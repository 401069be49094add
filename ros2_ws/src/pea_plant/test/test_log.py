import numpy as np
import pytest

from pea_core.params import build
from pea_plant.drivers.simulated import Params, Simulated
from pea_plant.model.creep import log


def step_response(params, t):
    tau, w = log.operators(params)
    return 1.0 + (1.0 - np.exp(-t[:, None] / tau)) @ w


def error(params):
    """Largest relative error of the fit at its best y(t_0)."""
    t = np.geomspace(params.first, params.first * 10.0**params.decades, 3000)
    L = 1.0 + params.rate * np.log10(t / params.first)
    F = step_response(params, t)
    return np.max(np.abs(F / L / np.mean(F / L) - 1.0))


@pytest.mark.parametrize("rate", [0.005, 0.015, 0.05])
@pytest.mark.parametrize("decades", [1, 3, 6])
@pytest.mark.parametrize(("per_decade", "limit"), [(1, 0.022), (2, 0.0065)])
def test_error_is_the_stated_part_of_the_rate(rate, decades, per_decade, limit):
    params = log.Params(rate=rate, decades=decades, per_decade=per_decade)
    assert error(params) < limit * rate


def test_growth_a_decade_is_the_rate():
    params = log.Params(rate=0.02, first=0.01, decades=4)
    y = step_response(params, np.array([0.01, 0.1, 1.0, 10.0, 100.0]))
    np.testing.assert_allclose(np.diff(y) / y[0], 0.02, rtol=0.04)


@pytest.mark.parametrize("rate", [0.0, 0.015, 0.3])
@pytest.mark.parametrize("per_decade", [1, 2])
@pytest.mark.parametrize("decades", range(1, 9))
def test_every_operator_adds_to_the_creep(rate, per_decade, decades):
    params = log.Params(rate=rate, decades=decades, per_decade=per_decade)
    tau, w = log.operators(params)
    assert tau.size == w.size == decades * per_decade + 1
    assert np.all(w >= -1e-12)


def test_actuator_creeps_logarithmically():
    # a coarse sample period steps just as exactly
    plant = Simulated(build(Params, {"creep.type": "log", "creep.enabled": True}), 0.05)
    x1 = {}
    for k in range(1000):
        plant.read()
        plant.write(50.0)
        x1[k + 1] = plant.truth.x1
    assert x1[1000] / x1[1] - 1.0 == pytest.approx(0.045, abs=5e-4)


def test_off_unless_enabled():
    plant = Simulated(build(Params, {"creep.type": "log"}), 50e-6)
    assert plant.s.x.size == 2
