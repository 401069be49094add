import importlib
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy import signal

from pea_core.params import ParameterError
from pea_identify import creep, hysteresis, noise
from pea_identify.files import read
from pea_identify.modes import Modes
from pea_identify.records import record
from pea_identify.results import plant
from pea_identify.stage import identify, settling
from pea_plant.model.hysteresis import CHOICE

TESTS = Path(__file__).parents[4] / "tests"
DATA = TESTS / "data"
sys.path.insert(0, str(TESTS / "identification"))
stages = importlib.import_module("stages")
T_s = 1e-3


def triangles(peaks=(80.0, 50.0, 70.0, 30.0, 60.0), n=250):
    parts = [
        np.concatenate([np.linspace(0, p, n + 1)[:-1], np.linspace(p, 0, n + 1)[:-1]])
        for p in peaks
    ]
    return np.concatenate([*parts, [0.0]])


def of(type, K=0.14e-6, sigma=1e-9, **values):
    u = triangles()
    v = hysteresis.driven(type, values, u)
    return record(u, K * v + sigma * np.random.default_rng(1).standard_normal(len(u)), T_s)


def test_branches_of_plays_are_those_of_the_plant():
    u = np.cumsum(np.random.default_rng(2).standard_normal(400))
    r, w = (0.0, 1.0, 4.0), (0.5, 0.3, 0.2)
    by_branch = hysteresis.plays(u, np.array(r)) @ w
    block = hysteresis.driven(
        "prandtl_ishlinskii", {"thresholds": r, "weights": w, "u_max": 10.0, "v_max": 8.9}, u
    )
    np.testing.assert_allclose(by_branch, block, atol=1e-12)


TRUTHS = {
    "prandtl_ishlinskii": {},
    "bouc_wen": {"alpha": 0.3, "beta": 0.03, "gamma": 0.015},
    "preisach": {"share": 0.3, "range_min": -30.0, "range_max": 120.0},
}


@pytest.mark.parametrize("type", TRUTHS)
def test_the_model_that_made_the_data_is_chosen(type):
    stage = identify([of(type, **TRUTHS[type])])
    assert stage.hysteresis.type == type
    assert stage.hysteresis.percent < 0.15
    values = TRUTHS[type]
    if type == "bouc_wen":
        for name, true in values.items():
            assert stage.hysteresis.values[name] == pytest.approx(true, rel=0.02)


def test_the_model_is_chosen_whatever_creep_there_is():
    """Creep is known from a step within some per cent only, and is slower than the triangles.

    A stage of `make identification`: V has modes, and y what they ring.
    """
    stage, rng, T_s = stages.draw(40), np.random.default_rng(1), stages.T_S
    slow = triangles((80.0, 60.0, 70.0, 40.0, 80.0, 50.0, 65.0, 30.0, 75.0), 4000)
    step = np.concatenate([np.zeros(2000), np.full(200_000, 40.0)])
    records = [record(u, stage.measured(u, rng), T_s) for u in (slow, step)]
    assert stage.H == identify(records).hysteresis.type == "preisach"


def test_thresholds_are_found_where_the_programme_has_none():
    r, w = (0.0, 1.7, 5.3, 12.0, 31.0), (0.55, 0.15, 0.1, 0.1, 0.1)
    truth = {"thresholds": r, "weights": w, "u_max": 80.0, "v_max": 67.0}
    made = of("prandtl_ishlinskii", sigma=0.3e-9, **truth)
    fit = identify([made], hysteresis_types=("prandtl_ishlinskii",)).hysteresis
    assert fit.moved
    found = np.array(fit.values["thresholds"])
    heavy = found[np.array(fit.values["weights"]) > 0.02]
    assert max(np.abs(heavy - each).min() for each in r) < 0.05
    assert fit.percent < 0.005
    # each weight that is told has its interval
    assert len(fit.intervals["weights"]) == len(fit.values["weights"])


def test_a_voltage_beyond_saturation_is_fitted():
    truth = {"share": 0.6, "range_min": -10.0, "range_max": 55.0, "u_max": 80.0, "v_max": 80.0}
    fit = identify([of("preisach", **truth)], hysteresis_types=("preisach",)).hysteresis
    assert fit.percent < 0.05
    assert fit.values["range_max"] == pytest.approx(55.0, rel=2e-3)


def test_a_straight_line_is_no_hysteresis():
    u = triangles()
    y = 0.14e-6 * u + 1e-9 * np.random.default_rng(1).standard_normal(len(u))
    stage = identify([record(u, y, T_s)])
    assert stage.hysteresis.type == "none"
    assert plant(stage)["K"] == pytest.approx(0.14, rel=1e-4)


def test_what_a_mode_rings_is_no_hysteresis():
    """The corners of a triangle excite a lightly damped mode."""
    u, T_s, omega, zeta = triangles(n=4000), 5e-5, 2.0 * np.pi * 383.0, 0.045
    system = [omega**2], [1.0, 2.0 * zeta * omega, omega**2]
    _, y, _ = signal.lsim(system, u, np.arange(len(u)) * T_s)
    noise = 1.9e-9 * np.random.default_rng(1).standard_normal(len(u))
    assert identify([record(u, 0.14e-6 * y + noise, T_s)]).hysteresis.type == "none"


def test_falling_displacement_is_refused():
    u = triangles()
    with pytest.raises(ParameterError, match="falls"):
        identify([record(u, -1e-7 * u, T_s)])


def test_a_curve_is_found_and_the_plant_has_it():
    stage = identify([of("modified_prandtl_ishlinskii")])
    fit = stage.hysteresis
    assert fit.type == "modified_prandtl_ishlinskii"
    assert fit.percent < 0.2
    values = dict(plant(stage)["hysteresis"])
    type, K = values.pop("type"), plant(stage)["K"] * 1e-6
    CHOICE.kinds[type](**values)  # within the plant's ranges
    u = stage.records[0].u[:, 0]
    said = K * hysteresis.driven(type, values, u)
    y = stage.records[0].y[:, 0]
    assert np.std(said - y) < 4e-3 * np.ptp(y)  # y_0 is the offset


def test_golden_fit_of_a_micromanipulator():
    """Measured data; 12 plays and a cubic leave 0.98 % of the stroke on other periods."""
    (made,) = read(DATA / "dbo_excerpt.csv").records
    stage = identify([made])
    assert stage.hysteresis.type == "modified_prandtl_ishlinskii"
    assert stage.hysteresis.percent < 0.75


def test_creep_of_a_step():
    tau, weights = np.array([0.1, 1.0]), np.array([0.02, 0.015])
    u = np.concatenate([np.zeros(500), np.full(9500, 40.0)])
    y = 0.14e-6 * creep.through(u, tau, weights, T_s)
    y += 0.5e-9 * np.random.default_rng(3).standard_normal(len(y))
    found = creep.identify(record(u, y, T_s), 0.02)
    # a slow way back to rest is no part of the hold
    back = np.linspace(1.0, 0.0, 4000)
    whole = record(np.append(u, u[-1] * back), np.append(y, y[-1] * back), T_s, kind="step")
    np.testing.assert_allclose(creep.identify(whole, 0.02).weights, found.weights, atol=1e-3)
    # and a soft move is one, too
    soft = 40.0 * np.clip((np.arange(10000) - 485) / 30.0, 0.0, 1.0)
    y_soft = 0.14e-6 * creep.through(soft, tau, weights, T_s)
    softly = creep.identify(record(soft, y_soft, T_s, kind="step"), 0.02)
    np.testing.assert_allclose(softly.model[0], 0.14e-6 * 40.0, rtol=0.01)
    np.testing.assert_allclose(softly.weights.sum(), weights.sum(), rtol=0.03)
    t = np.array([0.1, 1.0, 8.0])
    grown = [
        (w * -np.expm1(-t[:, None] / k)).sum(axis=1)
        for w, k in ((weights, tau), (found.weights, found.tau))
    ]
    np.testing.assert_allclose(grown[1], grown[0], atol=3e-4)


def test_a_hold_ends_before_a_soft_return():
    back = 20.0 * (1.0 + np.cos(np.linspace(0.0, np.pi, 800)))
    u = np.concatenate([np.zeros(500), np.full(9000, 40.0), back, np.zeros(50)])
    first, last, end = creep.hold_of(u)
    assert (first, last) == (499, 500)
    assert 9500 <= end <= 9560  # left by 1 % of the step


def test_what_settles_after_a_step_is_not_what_settles_after_its_return():
    one, none = np.ones((1, 1, 1)), np.zeros((1, 1, 1))
    V = Modes(
        omega_n=np.array([400.0]),
        zeta=np.array([0.5]),
        K=one,
        delay=0.0,
        creep=0.0,
        omega_n_95=np.zeros(1),
        zeta_95=np.zeros(1),
        K_95=none,
        delay_95=0.0,
        creep_95=0.0,
        gain_95=none[0],
        misfit=1.0,
        T_s=T_s,
    )
    back = 20.0 * (1.0 + np.cos(np.linspace(0.0, np.pi, 800)))
    u = np.concatenate([np.zeros(500), np.full(9000, 40.0), back, np.zeros(50)])
    # e^(-zeta omega_n t) = 1e-4 after 46 ms
    assert 0.03 < settling(V, record(u, 1e-7 * u, T_s, kind="step")) < 0.06


def test_a_step_too_short_for_creep_is_refused():
    u = np.concatenate([np.zeros(500), np.full(70, 40.0)])
    with pytest.raises(ParameterError, match="too short for creep"):
        creep.identify(record(u, 1e-7 * u, T_s, kind="step"), 0.02)


def test_noise_and_quantisation_at_rest():
    rng = np.random.default_rng(4)
    y = np.round(2e-9 * rng.standard_normal(20_000) / 1e-9) * 1e-9 + 0.3e-9
    found = noise.at_rest(y)
    assert found.quantisation == pytest.approx(1e-9, rel=1e-6)
    assert abs(found.rms - 2e-9) < 2.0 * found.rms_95
    assert noise.at_rest(2e-9 * rng.standard_normal(1000)).quantisation == 0.0
