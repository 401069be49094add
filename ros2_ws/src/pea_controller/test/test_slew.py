"""Laws under a slew limit: what they act on, what they follow, and what they refuse."""

import numpy as np
import pytest
from scipy.signal import cont2discrete

from pea_controller.model import MODELS, slew
from pea_controller.model.common import (
    BOUNDLESS,
    ActuatorLimits,
    CommonParams,
    following,
    limits,
    within,
)
from pea_core.nominal import NominalModel
from pea_core.params import ParameterError
from pea_core.signals import Estimate, Reference

T_S = 50e-6
ZETA, OMEGA_N, K = 0.82, 5450.0, 0.142e-6
A = np.array([[0.0, 1.0], [-(OMEGA_N**2), -2 * ZETA * OMEGA_N]])
B = np.array([[0.0], [K * OMEGA_N**2]])
PLANT = {
    "voltage_min": -20.0,
    "voltage_max": 110.0,
    "delay_samples": 1,
    "sensor.delay_samples": 0,
    "amplifier.slew_rate": 0.0,
    "safety.slew_rate": 0.0,
}


@pytest.mark.parametrize("delay", [0, 1, 2, 5, 20])
def test_a_law_sees_the_state_that_its_commands_would_have_made(delay):
    F, G = cont2discrete((A, B, np.eye(2), 0 * B), T_S)[:2]
    c = slew.design(NominalModel(), -20.0, 110.0, 20e3, delay, T_S)
    s = slew.at_rest(c)
    rng = np.random.default_rng(3)
    x = unlimited = np.zeros(2)
    before, queue, wanted = 0.0, [0.0] * delay, [0.0] * delay
    for u in rng.uniform(-10.0, 100.0, 200):
        seen = slew.freed(s, Estimate(*x, 0.0))
        assert np.allclose(seen[:2], unlimited, rtol=0.0, atol=1e-15)
        before += np.clip(np.clip(u, -20.0, 110.0) - before, -20e3 * T_S, 20e3 * T_S)
        queue.append(before)
        wanted.append(u)
        x = F @ x + G[:, 0] * queue.pop(0)
        unlimited = F @ unlimited + G[:, 0] * wanted.pop(0)
        s = slew.kept_back(c, s, float(u))


@pytest.mark.parametrize("name", MODELS)
def test_no_bit_changes_where_a_slew_limit_is_never_met(name):
    model = MODELS[name]
    eps = name in ("predictive", "state_feedback", "pidsmc_modal")  # they rest on it
    laws = [
        model.design(model.Params(slew_rate=rate, eps_compensation=eps), T_S) for rate in (0.0, 1e9)
    ]
    states = [model.start(c) for c in laws]
    for t in np.arange(200) * T_S:
        W = Reference(1e-6 * np.sin(600.0 * t), 6e-4 * np.cos(600.0 * t), 0.0)
        x = Estimate(0.98 * W.w, W.w_dot, 0.3)
        u = [model.output(c, s, W, W, x) for c, s in zip(laws, states, strict=True)]
        assert u[0] == u[1]
        states = [model.update(c, s, W, W, x, u[0]) for c, s in zip(laws, states, strict=True)]


def test_a_law_follows_the_tighter_slew_limit_of_the_plant():
    assert following(PLANT)["slew_rate"] == 0.0
    assert following({**PLANT, "safety.slew_rate": 3e4})["slew_rate"] == 3e4
    both = {**PLANT, "safety.slew_rate": 3e4, "amplifier.slew_rate": 2e4}
    assert limits(both) == ActuatorLimits(-20.0, 110.0, 2e4)
    least = {name: PLANT[name] for name in ("voltage_min", "voltage_max", "delay_samples")}
    assert following(least) == following(PLANT)  # a plant that is not ours


@pytest.mark.parametrize(("rate", "told"), [(0.0, r"slew_rate = 0 \(no limit\)"), (5e4, "50000")])
def test_a_slew_limit_looser_than_the_plants_is_refused(rate, told):
    plant = ActuatorLimits(-20.0, 110.0, 4e4)
    with pytest.raises(ParameterError, match=f"{told}: looser than the plant's 40000 V/s"):
        within(CommonParams(slew_rate=rate), plant)
    within(CommonParams(slew_rate=4e4), plant)
    within(CommonParams(slew_rate=rate), BOUNDLESS)


def test_predictive_without_feedforward_is_refused():
    with pytest.raises(ParameterError, match="feedforward = False: this law"):
        MODELS["predictive"].Params(feedforward=False)
