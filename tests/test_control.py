"""Loops with limits: what a raw step leaves, and what the real q' of Eq 14 is worth."""

import dataclasses

import numpy as np
import pytest

from pea_core.block import changed
from pea_core.loop import blocks_of, trace
from pea_core.params import ParameterError
from pea_experiment import experiments
from pea_experiment.experiment import SCHEMAS
from pea_lab import guard
from pea_lab.check import check
from pea_lab.settling import oscillation, refuse_steps

STEP = (
    "reference.type=step",
    "reference.offset_um=0",
    "reference.amplitude_um=5",
    "reference.time=0.002",
)


def displacement(name, sets, duration):
    experiment = experiments.load(name, sets, duration)
    loop = experiment.loop()
    return trace([loop.run(n) for n in blocks_of(experiment.samples)])["y"]


LATE = ("observer.preset=measured",)
TWO_MODES = (*LATE, "plant.preset=resonant_two_modes")
ONE_MODE = tuple(
    f"{node}.{value}"
    for node in ("plant", "observer", "controller")
    for value in ("zeta=0.01", "omega_n=4643.274", "K=0.135")
)
STAGES = {
    "damped_irc": ONE_MODE,
    "disturbance_observer": (),
    "late_4": (*LATE, "plant.preset=sensor_4_late"),
    "late_8": (*LATE, "plant.preset=sensor_8_late"),
    "paper_set1": (),
    "paper_set2": (),
    "pid": (),
    "pid_2khz": ("T_s=0.0005", "observer.preset=extended_state_2khz"),
    "pid_500hz": ("T_s=0.002", "observer.preset=extended_state_500hz"),
    "precise": (),
    "recommended": (),
    "resonant": TWO_MODES,
    "resonant_fast": TWO_MODES,
    "resonant_pidsmc": TWO_MODES,
    "resonant_4": (*LATE, "plant.preset=resonant_two_modes_4"),
    "resonant_9": (*LATE, "plant.preset=resonant_two_modes_9"),
    **{
        f"resonant{late}_{kind}": (
            *LATE,
            f"plant.preset=resonant_two_modes{late}",
            f"plant.hysteresis.type={kind}",
        )
        for late in ("", "_4", "_9")
        for kind in ("preisach", "bouc_wen")
    },
}
REFUSED = ("open_loop", "smc", "smc_boundary_layer")


def test_every_preset_has_a_stage_or_is_refused():
    assert {*STAGES, *REFUSED} == set(experiments.presets("controller"))


@pytest.mark.parametrize("preset", STAGES)
def test_a_raw_step_under_a_slew_limit_comes_to_rest(preset):
    limit = "amplifier.slew_rate=40000" if len(preset) % 2 else "safety.slew_rate=80000"
    sets = (*STEP, *STAGES[preset], f"controller.preset={preset}", f"plant.{limit}")
    y = displacement("sine_series", sets, 0.3 if preset == "paper_set1" else 0.13)
    assert np.abs(y[-y.size // 20 :] - 5e-6).max() < 50e-9


@pytest.mark.parametrize("limit", ["amplifier.slew_rate=40000", "safety.slew_rate=80000"])
@pytest.mark.parametrize("preset", REFUSED)
def test_a_law_that_does_not_hold_a_step_is_refused(preset, limit):
    sets = (*STEP, f"controller.preset={preset}", f"plant.{limit}")
    with pytest.raises(
        ParameterError, match=r"step of 5 um under controller\.slew_rate = .*leaves"
    ):
        refuse_steps(experiments.load("sine_series", sets, 0.1))


@pytest.mark.parametrize(
    "sets",
    [
        ("reference.type=constant",),
        ("reference.type=levels", "reference.move_s=[0.0]", "reference.hold_s=[0.02]"),
        ("reference.type=step", "reference.amplitude_um=-5", "reference.time=0.01"),
    ],
    ids=["constant", "levels", "down"],
)
def test_every_kind_of_raw_step_is_seen(sets):
    more = ("controller.preset=smc_boundary_layer", "plant.amplifier.slew_rate=40000")
    with pytest.raises(ParameterError, match="raw step of 5 um"):
        refuse_steps(experiments.load("sine_series", (*sets, *more), 0.1))


@pytest.mark.parametrize(
    "sets",
    [
        ("reference.type=sine",),
        (*STEP, "reference.shape=minimum_jerk"),
        ("reference.type=step", "reference.shaper.type=smooth"),
    ],
    ids=str,
)
def test_what_is_no_raw_step_is_not_refused(sets):
    more = ("controller.preset=smc_boundary_layer", "plant.amplifier.slew_rate=40000")
    refuse_steps(experiments.load("sine_series", (*sets, *more), 0.1))


SLOW = ("controller.preset=open_loop", "plant.amplifier.slew_rate=40000")


def test_the_axis_whose_law_does_not_hold_a_step_is_named():
    sets = ["reference.type=step", "plant.amplifier.slew_rate=40000"]
    stage = experiments.load_axes("raster_xy", [*sets, "controller.y.preset=open_loop"])
    with pytest.raises(ParameterError, match=r"^raster_xy: axis y: .*leaves"):
        refuse_steps(stage.each[1])


def changed_to(reference, strict, shaper="none"):
    """Judge a reference that takes the place of one at rest; what was warned of."""
    sets = ("reference.type=constant", "reference.offset_um=0", f"reference.shaper.type={shaper}")
    loaded = experiments.load("sine_series", (*sets, *SLOW, f"controller.tuning.guard={strict}"))
    running = {name: node.params for name, node in loaded.nodes.items()}
    new = changed(SCHEMAS["reference"], running["reference"], reference)
    said = []
    guard.guard(loaded, running, "reference", new, said.append)
    return said


@pytest.mark.parametrize("reference", [{"offset_um": 5.0}, {"offset_um": -5.0}])
def test_a_setpoint_that_jumps_while_the_loop_runs_is_refused(reference):
    with pytest.raises(ParameterError, match=r"raw step of 5 um .*: give a shaper"):
        changed_to(reference, "refuse")


def test_a_setpoint_that_jumps_is_warned_of_where_the_law_says_so():
    (said,) = changed_to({"offset_um": -4.0}, "warn")
    assert "raw step of 4 um" in said


@pytest.mark.parametrize(
    ("offset", "strict", "shaper"),
    [(5.0, "off", "none"), (0.01, "refuse", "none"), (5.0, "refuse", "smooth")],
)
def test_a_setpoint_that_does_not_jump_is_taken(offset, strict, shaper):
    assert changed_to({"offset_um": offset}, strict, shaper) == []


def test_nodes_started_by_hand_judge_a_raw_step_as_it_begins():
    sets = ("reference.type=levels", "reference.move_s=[0.0]")
    loaded = experiments.load("sine_series", (*sets, *SLOW))
    values = {name: dict(node.values) for name, node in loaded.nodes.items()}
    params = loaded.nodes["reference"].params
    with pytest.raises(ParameterError, match="raw step of 5 um"):
        guard.of_nodes(values, "reference", params, print)


def test_a_slew_limit_looser_than_the_plants_is_refused_by_name():
    sets = ["plant.safety.slew_rate=40000", "controller.slew_rate=50000"]
    with pytest.raises(ParameterError, match=r"^controller\.slew_rate = 50000: looser"):
        experiments.load("sine_series", sets)


@pytest.mark.parametrize("setting", [(), ("controller.preset=paper_set2",)])
@pytest.mark.parametrize("D_c", [1e-8, 1e-6, 1e-3])
def test_the_measured_q_dot_keeps_the_poles_for_every_D_c(setting, D_c):
    def largest(q_dot):
        sets = (*setting, f"controller.D_c={D_c}", f"controller.q_dot={q_dot}")
        return check(experiments.load("sine_series", sets))["largest_pole"]

    assert largest("measured") == pytest.approx(largest("nominal"), abs=1e-6)
    assert largest("measured") < 1.0


def test_with_the_real_q_dot_the_derivative_gain_costs_nothing():
    def error(*sets):
        y = displacement("fig9_hysteresis_10hz", sets, 0.2)
        t = np.arange(y.size) * 50e-6
        miss = (y - 5e-6 * np.sin(20 * np.pi * t) - 5e-6)[y.size // 2 :]
        return np.sqrt(np.mean(miss**2)) * 1e9

    without, real = error("controller.D_c=0"), error("controller.q_dot=measured")
    assert (without, real, error()) == pytest.approx((13.28, 13.29, 13.85), abs=0.01)


@pytest.mark.parametrize(
    "sets",
    [
        ("controller.preset=precise", "plant.zeta=0.7", "plant.omega_n=4360"),
        ("controller.preset=precise", "plant.zeta=0.6", "plant.K=0.1633"),
        ("observer.preset=kalman_rate", "plant.omega_n=4087.5"),
    ],
)
def test_a_limit_cycle_of_a_loop_with_good_poles_is_seen(sets):
    experiment = experiments.load("sine_series", sets)
    seen = oscillation(experiment)
    assert seen is not None
    assert 200.0 < seen.rms_nm < 4000.0
    assert check(experiment)["stable"]


@pytest.mark.parametrize("preset", ["recommended", "precise", "paper_set1", "smc_boundary_layer"])
def test_a_preset_comes_to_rest_on_the_stage_that_it_is_for(preset):
    assert oscillation(experiments.load("sine_series", [f"controller.preset={preset}"])) is None


def test_the_guard_refuses_gains_that_keep_oscillating():
    plant = ("plant.zeta=0.7", "plant.omega_n=4360")
    experiment = experiments.load("sine_series", ["controller.preset=precise", *plant])
    law = experiment.nodes["controller"].params
    anyway = dataclasses.replace(law.tuning, delay_margin=0.0)
    told = guard.judge(experiment, {"controller": dataclasses.replace(law, tuning=anyway)})
    assert told is not None
    assert told.startswith("keeps oscillating by")
