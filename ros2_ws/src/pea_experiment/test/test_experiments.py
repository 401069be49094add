"""Experiments: their segments and moves, exchanged nodes, and what is refused in one line."""

import math

import pytest

from pea_core.params import ParameterError, specs
from pea_experiment import checks, experiments
from pea_experiment.experiment import SCHEMAS, sections
from pea_experiment.scoring import Move
from pea_experiment.switches import SWITCHES

NAMES = (
    "fig10_sine_150hz",
    "fig4_pid_step",
    "fig5_frequency_response",
    "fig8_initial_condition",
    "fig9_hysteresis_10hz",
    "sine_series",
)


def load(name="sine_series", *sets, **more):
    return experiments.load(name, sets, 0.01, **more)


def test_every_experiment_of_the_paper_is_there():
    assert set(NAMES) <= set(experiments.names())


def test_segments_are_told_in_samples():
    parts = load().segments
    assert [s.frequency_hz for s in parts] == [1.0, 10.0, 50.0, 100.0, 150.0]
    assert [round(s.start) for s in parts] == [0, 40000, 50000, 54000, 58000]
    assert parts[4].period == pytest.approx(20000 / 150)


def test_a_sine_goes_on_without_end():
    (part,) = load("fig9_hysteresis_10hz").segments
    assert part == (0.0, math.inf, pytest.approx(2000.0), 10.0)


def test_a_step_is_a_move_and_a_sine_is_none():
    assert load("fig4_pid_step").move == Move(40, pytest.approx(5e-6))
    assert load("fig8_initial_condition").move == Move(0, 0.0)
    assert load("fig9_hysteresis_10hz").move is None
    assert load("fig8_initial_condition").segments == []


def test_an_exchanged_controller_leaves_nothing_of_the_old_one():
    values = load("fig9_hysteresis_10hz", others={"controller": "pid"}).nodes["controller"].values
    assert values["type"] == "pid"
    assert values["preset"] == "pid"
    assert values["K_p"] == 8.5


@pytest.mark.parametrize(
    ("node", "type_"),
    [
        (node, type_)
        for node in ("observer", "controller")
        for type_, params in SCHEMAS[node].kinds.items()
        if "PRESET" in vars(params)
    ],
)
def test_a_type_on_the_command_line_comes_with_its_own_preset(node, type_):
    own = SCHEMAS[node].kinds[type_].PRESET
    ideal = "plant.sensor.ideal=true"  # for passthrough
    preset = load("sine_series", ideal, f"{node}.preset={own}").nodes[node].values
    assert preset["type"] == type_
    assert load("sine_series", ideal, f"{node}.type={type_}").nodes[node].values == preset
    assert load("sine_series", ideal, others={node: type_}).nodes[node].values == preset


def test_an_exchanged_controller_keeps_the_sample_period():
    experiment = load("sine_series", "T_s=1e-4", others={"controller": "pid"})
    assert experiment.T_ns == 100_000


def test_the_command_line_is_laid_over_an_exchanged_node():
    experiment = load("sine_series", "controller.K_p=7", others={"controller": "pid"})
    assert experiment.nodes["controller"].values["K_p"] == 7.0


def test_an_exchanged_plant_keeps_what_the_new_one_does_not_say():
    experiment = load("fig9_hysteresis_10hz", others={"plant": "hysteresis_creep_noise_delay"})
    plant = experiment.nodes["plant"].params
    assert plant.sensor.ideal
    assert plant.voltage_max == 1000.0
    assert plant.delay_samples == 1
    assert plant.sensor.noise_nm == 0.7
    assert experiment.nodes["controller"].params.delay_samples == 1


def test_a_plant_may_be_a_type_of_hysteresis():
    values = load(others={"plant": "preisach"}).nodes["plant"].values
    assert values["hysteresis.type"] == "preisach"
    assert values["creep.enabled"]


@pytest.mark.parametrize("node", ["plant", "observer", "controller"])
def test_an_unknown_name_is_told_with_what_is_known(node):
    with pytest.raises(ParameterError, match=f"unknown {node} 'nix': known: .*"):
        load(others={node: "nix"})


@pytest.mark.parametrize(
    ("sets", "fits"),
    [
        (["reference.amplitude_um=7.84"], True),
        (["reference.amplitude_um=7.85"], False),
        (["reference.amplitude_um=9", "reference.offset_um=6.6"], True),
        (["plant.voltage_min=0", "plant.voltage_max=70.5"], True),
        (["plant.voltage_min=0", "plant.voltage_max=70.4"], False),
        (["plant.K=0.09"], False),
    ],
    ids=str,
)
def test_a_reference_must_be_within_voltage_range_times_K(sets, fits):
    sets = ["reference.type=sine", "reference.frequency_hz=1000", *sets]
    if fits:
        load("sine_series", *sets)
    else:
        with pytest.raises(ParameterError, match=r"reference from .* outside the stroke of .* um"):
            load("sine_series", *sets)


def test_a_reference_that_is_no_number_is_out_of_reach():
    plant = load().nodes["plant"].params
    with pytest.raises(ParameterError, match="outside the stroke"):
        checks.within_reach(math.nan, math.nan, plant, 0.142)


def test_an_error_of_a_file_names_the_node(tmp_path):
    with pytest.raises(ParameterError, match=r"^plant\.load\.path = .* No such file"):
        load("sine_series", "plant.load.type=file", f"plant.load.path={tmp_path / 'no.csv'}")


def test_the_gain_of_all_modes_counts_for_the_stroke():
    with pytest.raises(ParameterError, match=r"times 0\.05 um/V"):
        load(
            "sine_series",
            "plant.vibration.type=modal",
            "plant.vibration.K=[0.04, 0.01]",
            "reference.frequencies_hz=[200]",
            "reference.periods=[1]",
        )


def test_a_long_run_is_looked_at_too():
    with pytest.raises(ParameterError, match="outside the stroke"):
        experiments.load("fig4_pid_step", ["reference.amplitude_um=20", "reference.time=5"], 10.0)


@pytest.mark.parametrize(
    ("sets", "start"),
    [
        (["T_s=0.05", "reference.frequencies_hz=[1]", "reference.periods=[2]"], "observer.type = "),
        (["reference.frequencies_hz=[20000]", "reference.periods=[2]"], "reference.frequencies_hz"),
        (["reference.type=file"], "reference.path = ''"),
    ],
    ids=str,
)
def test_a_design_that_fails_names_its_node(sets, start):
    with pytest.raises(ParameterError) as error:
        experiments.load("sine_series", sets, 1.0)
    assert str(error.value).startswith(start)
    assert "\n" not in str(error.value)


def figures(eps, left):
    return {"eps_max_V": eps, "eps_left_max_V": left}


@pytest.mark.parametrize("law", ["smc", "smc_boundary_layer"])
def test_eta_below_the_eps_of_the_run_is_warned_of(law):
    experiment = load("sine_series", f"controller.preset={law}", "controller.eta=5")
    assert "controller.eta = 5 V: below |eps| of up to 6 V" in checks.too_small(
        experiment, figures(6.0, 1.0)
    )
    assert checks.too_small(experiment, figures(4.9, 1.0)) is None


def test_where_eps_is_compensated_only_what_is_left_of_it_counts():
    experiment = load("sine_series", "controller.preset=smc", "controller.eps_compensation=true")
    assert checks.too_small(experiment, figures(50.0, 1.0)) is None
    assert "|eps - eps_hat|" in checks.too_small(experiment, figures(50.0, 13.0))


def test_laws_without_eta_need_no_bound():
    assert checks.too_small(load(), figures(50.0, 50.0)) is None


def test_without_truth_there_is_no_warning():
    experiment = load("sine_series", "controller.preset=smc")
    assert checks.too_small(experiment, figures(None, None)) is None


@pytest.mark.parametrize(
    ("sets", "notes"),
    [
        (["controller.type=pid"], ["controller: type pid begins at its preset pid"]),
        (["observer.type=measured"], ["observer: type measured begins at its preset measured"]),
        (
            ["controller.type=state_feedback"],
            ["controller: type state_feedback has no preset: it begins at defaults"],
        ),
        (
            ["controller.type=pidsmc_modal", "controller.P=0.002"],
            ["controller: type pidsmc_modal has no preset: it begins at defaults"],
        ),
        (["controller.preset=pid"], []),
        (["controller.P=0.002"], []),
    ],
)
def test_a_type_that_is_typed_alone_says_where_it_begins(sets, notes):
    assert experiments.load("fig9_hysteresis_10hz", sets).notes == notes


@pytest.mark.parametrize("name", sorted(experiments.names()))
def test_every_experiment_that_comes_with_it_can_be_run(name):
    made = experiments.load_axes(name)
    assert made.samples > 0
    again = sections(made.each)
    assert again["plant"]["axes"] == made.axes


@pytest.mark.parametrize("name", ["preset", "c.preset"])
def test_a_preset_lies_beside_the_file_that_names_it(tmp_path, monkeypatch, name):
    lab, elsewhere = tmp_path / "lab", tmp_path / "else"
    for folder, m in ((lab, 6000), (elsewhere, 7000)):
        folder.mkdir()
        values = f"{{ros__parameters: {{type: pidsmc, m: {m}}}}}"
        (folder / "mine.yaml").write_text(f"/**/controller: {values}\n")
    there = lab / "exp.yaml"
    there.write_text(
        f"/**/controller: {{ros__parameters: {{{name}: mine.yaml}}}}\n"
        "/**/plant: {ros__parameters: {axes: [b, c]}}\n"
    )
    (elsewhere / "again.yaml").write_text(
        "/**/controller: {ros__parameters: {preset: ../lab/mine.yaml}}\n"
    )
    monkeypatch.chdir(elsewhere)
    with pytest.raises(ParameterError, match="give the whole path"):  # there are two
        experiments.load_axes(str(there))
    (elsewhere / "mine.yaml").unlink()
    assert experiments.load_axes(str(there)).each[1].nodes["controller"].params.m == 6000
    monkeypatch.chdir(tmp_path)
    found = experiments.load_axes(str(there), ["controller.preset=else/again.yaml"])
    assert found.each[0].nodes["controller"].params.m == 6000


@pytest.mark.parametrize(
    ("sets", "notes"),
    [
        (
            ["reference.shaper.velocity_max=100"],
            ["reference.shaper.velocity_max: has no effect while reference.shaper.type = none"],
        ),
        (["reference.shaper.velocity_max=100", "reference.shaper.type=smooth"], []),
        (
            ["plant.creep.tau=[0.1, 1.0, 5.0, 50.0]"],
            ["plant.creep.tau: has no effect while plant.creep.enabled = false"],
        ),
        (
            ["axes=[a, b]", "controller.b.inject.lines=9"],
            ["controller.inject.lines: has no effect while controller.inject.where = off"],
        ),
    ],
)
def test_what_is_typed_and_has_no_effect_is_told(sets, notes):
    assert experiments.load_axes("fig4_pid_step", sets).notes == notes


def test_every_switch_is_a_parameter_that_turns_others_off():
    for (node, begin), (switch, off) in SWITCHES.items():
        schema = SCHEMAS[node]
        kinds = [{"type": kind} for kind in schema.kinds] if hasattr(schema, "kinds") else [{}]
        known = [specs(schema, kind) for kind in kinds]
        assert any(switch in own and any(n.startswith(begin) for n in own) for own in known)
        assert any(own[switch].check(switch, off) == off for own in known if switch in own)
