"""Delays divided among what can be late; a law's model and inverse from what was identified."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from pea_core.loop import blocks_of, trace
from pea_identify import slow
from pea_identify.modes import Modes
from pea_measure import commissioning, plans, proposing
from pea_measure.identifying import determined, divided

T_S = 50e-6


def late(samples, command, sensor, modal_model=True, half=0.0):
    found = SimpleNamespace(delay=samples * T_S, delay_95=half * T_S)
    plant = SimpleNamespace(delay_samples=command, sensor=SimpleNamespace(delay_samples=sensor))
    return divided(found, plant, modal_model, T_S)


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ((4.0, 1, 3), (1, 0.0)),  # all that the rig says of: nothing counts twice
        ((4.3, 1, 3), (1, 0.3)),
        ((6.4, 1, 3), (1, 2.4)),
        ((4.001, 1, 3), (1, 0.0)),
        ((4.01, 1, 3), (1, 0.01)),
        ((4.2, 1, 3, True, 0.25), (1, 0.2)),  # however wide its interval, the best that is known
        ((3.9, 1, 3, True, 0.25), (1, 0.0)),
        ((3.0, 1, 3), (0, 0.0)),  # less than the rig says: the command is not late
        ((4.0, 1, 3, False), (1, 0.0)),
        ((2.4, 0, 0, False), (2, 0.0)),
        ((1.0, 0, 0, False), (1, 0.0)),
    ],
)
def test_a_delay_is_divided(given, told):
    command, rest = late(*given)
    assert command == told[0]
    assert rest / T_S == pytest.approx(told[1], abs=1e-9)


def test_modes_that_explain_little_are_not_those_of_the_stage():
    modes = SimpleNamespace(error=0.997)
    told = determined(SimpleNamespace(modes=modes, response=SimpleNamespace(f=[10.0, 8000.0])))
    assert told == (
        "the resonance is not determined: modes leave 99.7 % of the response unexplained; "
        "what the rig says of it stays"
    )


def test_levels_in_open_loop_are_voltages_by_the_gain_of_the_plant():
    base = plans.Base("sine_series", ("plant.K=0.28", "controller.K=0.1"))
    assert pytest.approx(0.28) == base.load(plans.OPEN).nodes["controller"].params.K


def test_gains_are_judged_within_the_stroke_that_was_found():
    """A stage may move by less than the rig's file says."""
    base, model = plans.Base("sine_series"), {"sets": ["plant.K=0.09"]}
    loop = proposing.on(base, model["sets"], proposing.judged_on(base, model))
    assert loop.nodes["reference"].params.amplitude_um == pytest.approx(0.25 * 0.09 * 130.0)


def identified(*sets):
    """What a commissioning finds of a plant, in this process."""
    base = plans.Base("sine_series", sets)
    made = commissioning.measurements(base, None, None)
    samples = {}
    for name, each in made.items():
        loop = each.experiment.loop()
        samples[name] = trace([loop.run(n) for n in blocks_of(each.experiment.samples)])
    return commissioning.identified(base, made, samples)


def value(settings, name):
    """The last value that settings give a parameter."""
    (*_, told) = (one.partition("=")[2] for one in settings if one.startswith(f"{name}="))
    return json.loads(told)


def test_precise_takes_the_identified_stage(monkeypatch):
    monkeypatch.setattr(commissioning, "SLOW", 0.5)
    monkeypatch.setattr(slow, "POINTS", 600)
    plant = ("plant.preset=hysteresis_creep_noise_delay", "T_s=2e-4", "plant.zeta=0.5")
    model = identified("controller.preset=precise", "plant.delay_samples=0", *plant)
    sets = model["sets"]
    assert value(sets, "controller.zeta") == pytest.approx(0.5, rel=0.02)
    assert value(sets, "observer.omega_n") == pytest.approx(5450.0, rel=0.01)
    r, w = value(sets, "controller.inverse.thresholds"), value(sets, "controller.inverse.weights")
    K = value(sets, "controller.K")
    small = sum(weight for threshold, weight in zip(r, w, strict=True) if threshold < 0.5)
    assert K * small == pytest.approx(0.142 * 0.5132, rel=0.05)
    assert len(r) == len(w) > 5
    assert value(sets, "controller.hysteresis_max") == 0


@pytest.mark.parametrize(
    ("zeta", "half_width", "share"),
    [
        (0.01, 1e-4, 0.01),  # a modal law: what drifts is not in an interval
        (0.01, 0.02, 0.04),  # twice the interval, which is wider
        (0.82, 1e-4, 0.03),  # a law that knows no modes
        (0.82, 0.05, 0.05),
    ],
)
def test_a_law_is_checked_on_the_spread_of_what_it_knows(zeta, half_width, share):
    omega_n = 2.0 * np.pi * 739.0
    one, K = np.array([1.0]), np.full((1, 1, 1), 0.1e-6)
    V = Modes(
        *(omega_n * one, zeta * one, K, 0.0, 0.0),
        *(half_width * omega_n * one, 0.01 * one, 0.01 * K, 1e-6, 0.0, 0.01 * K[0], 1.0, T_S),
    )
    found = commissioning.Slow(0.1, 0.05, 0.7, [], [], {})
    experiment = plans.Base("sine_series").load()
    fast = commissioning.fast_part(V, found, experiment, law_given=False)
    plants, _ = commissioning.plants_about(found, fast)
    name = "plant.omega_n" if fast.shapes is None else "plant.vibration.omega_n"
    for sign in (-1.0, 1.0):
        told = value(plants[f"resonance {100.0 * sign * share:+.2g} %"], name)
        assert np.ravel(told) == pytest.approx((1.0 + sign * share) * omega_n)


def test_a_stage_without_hysteresis_gets_no_inverse():
    told = commissioning.inverse("none", {}, 90.0)
    assert "controller.inverse.weights=[1]" in told
    assert "controller.inverse.alpha=0" in told


@pytest.mark.parametrize(
    ("name", "rig"), [("sine_series", "e727_200hz_emulated"), ("sine_series@y", "e727_xy_emulated")]
)
def test_gains_are_proposed_on_a_simulated_plant_whatever_was_set_of_the_driver(name, rig):
    sets = ("plant.driver.address=tcp://127.0.0.1:1", "plant.driver.timeout_s=0.5")
    base = plans.Base(name, (*sets, "reference.type=constant", "reference.offset_um=1"), rig)
    plant = proposing.on(base).nodes["plant"]
    assert plant.values["driver.type"] == "simulated"
    assert base.load().nodes["plant"].values["driver.timeout_s"] == 0.5


def test_what_was_set_of_one_axis_of_a_driver_is_left_out_too():
    sets = ("plant.y.driver.calibration.sensor=[0, 1.01]", "reference.type=constant")
    base = plans.Base("sine_series@y", sets, "e727_xy_emulated")
    assert proposing.on(base).nodes["plant"].values["driver.type"] == "simulated"
