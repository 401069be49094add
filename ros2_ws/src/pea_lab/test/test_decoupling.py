"""Decoupling of a stage: beside its response, and in closed form."""

import numpy as np
import pytest

from pea_core.params import ParameterError
from pea_experiment import experiments
from pea_lab.coupled import plant
from pea_lab.decoupling import bare, decouple, first_mode, response

MODES = (
    "axes=[x,y]",
    "plant.hysteresis.type=none",
    "plant.creep.enabled=false",
    "plant.vibration.type=modal",
    "plant.vibration.omega_n=[4000, 7000]",
    "plant.vibration.zeta=[0.02, 0.02]",
    "plant.vibration.K=[0.1, 0.05]",
    "plant.stage.modes_K=[0, 0, 0.03, -0.01, -0.02, 0.02, 0, 0]",
)
K = np.array([[0.15, 0.02], [0.0, 0.15]])


@pytest.fixture(scope="module")
def stage():
    return experiments.load_axes("fig9_hysteresis_10hz", MODES, 0.05)


def test_one_tap_is_the_inverse_of_the_gain_times_its_diagonal(stage):
    found = decouple(stage, 1, 500.0)
    np.testing.assert_allclose(found.taps[0], np.linalg.solve(K, np.diag(np.diag(K))), atol=1e-7)


def test_a_filter_leaves_less_than_the_matrix_up_to_the_edge(stage):
    edge = 0.8 * first_mode(stage)
    assert first_mode(stage) == pytest.approx(4000.0 / (2.0 * np.pi))
    found = decouple(stage, 24, edge)
    assert found.after.max() < found.static.max() / 10.0
    np.testing.assert_allclose(found.taps.sum(axis=0), decouple(stage, 1, edge).taps[0], atol=1e-4)


def test_what_it_says_is_what_the_stage_then_does(stage):
    found = decouple(stage, 16, 400.0)
    sets = [*MODES, f"plant.stage.axes_to_actuators={found.taps.ravel().tolist()}"]
    after = experiments.load_axes("fig9_hysteresis_10hz", sets, 0.05)
    z = np.exp(2j * np.pi * found.f * stage.T_s)
    G = response(plant(after), z)
    seen = np.maximum(np.abs(G[:, 0, 1]), np.abs(G[:, 1, 0])) / 0.15e-6
    np.testing.assert_allclose(seen, found.after, rtol=1e-3, atol=1e-7)
    np.testing.assert_allclose(response(plant(bare(after)), z), response(plant(stage), z))


@pytest.mark.parametrize(
    ("sets", "taps", "edge", "said"),
    [
        ((), 8, 1e5, "--to 100000 Hz: must be above 0 and below 10000 Hz"),
        (("plant.stage.modes_K=[0, 0, 0.1, 0.05, 0.1, 0.05, 0, 0]",), 1, 500.0, "is singular"),
    ],
)
def test_what_cannot_be_decoupled_is_refused(sets, taps, edge, said):
    stage = experiments.load_axes("fig9_hysteresis_10hz", [*MODES, *sets], 0.05)
    with pytest.raises(ParameterError, match=said):
        decouple(stage, taps, edge)
