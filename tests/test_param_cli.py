"""``pea param``, ``pea tune`` and the guard: what they take, refuse and find."""

import json
import subprocess
import sys

import numpy as np
import pytest

from pea_cli import param as param_cli
from pea_core import config
from pea_core.block import changed
from pea_core.params import ParameterError, specs
from pea_experiment.experiment import SCHEMAS
from pea_lab import guard, steps
from pea_lab.check import check
from pea_ros.block_node import LoopParams
from pea_ros.params import descriptor
from pea_run.recorder.node import Params as RecorderParams


@pytest.fixture(scope="module")
def tracking():
    return steps.tracking("recommended", "extended_state")


def gains(experiment, **values):
    return changed(SCHEMAS["controller"], experiment.nodes["controller"].params, values)


# The guard


@pytest.mark.parametrize("law", ["recommended", "precise", "pid", "paper_set2"])
def test_the_margin_is_that_of_check(law):
    experiment = steps.tracking(law, "extended_state")
    figures = check(experiment)
    found = guard.margins(experiment, 4.0)
    for name, margin in (("gain_margin", found.command), ("actuator_gain", found.actuator)):
        upper, lower = figures[f"{name}_upper"], figures[f"{name}_lower"]
        least = min(upper or np.inf, 1.0 / lower if lower else np.inf, 4.0)
        assert least / margin == pytest.approx(1.0, abs=0.0101)
    assert found.gain == min(found.command, found.actuator)
    assert min(figures["gain_margin"], 4.0) / found.gain == pytest.approx(1.0, abs=0.0101)
    assert found.delay == figures["delay_margin_samples"]


def test_an_unstable_set_is_told_with_its_margin(tracking):
    told = guard.judge(tracking, {"controller": gains(tracking, P=0.01)})
    assert told == "gain margin 0.55 < 1.3 at T_s 50 us (at the command)"


def test_a_loop_that_bears_no_delay_is_told(tracking):
    wary = gains(tracking, **{"tuning.delay_margin": 2.0})
    told = guard.judge(
        tracking, {"controller": changed(SCHEMAS["controller"], wary, {"P": 0.0035})}
    )
    assert told == "delay margin 1.72 < 2 samples at T_s 50 us"


@pytest.mark.parametrize(
    ("name", "figure", "unit"),
    [("modulus", "modulus_margin", ""), ("phase", "phase_margin_deg", " deg")],
)
def test_margins_that_are_asked_for_are_judged(tracking, name, figure, unit):
    has = check(tracking)[figure]
    for enough, refused in ((1.02 * has, True), (0.98 * has, False)):
        asked = gains(tracking, **{f"tuning.{name}_margin": enough})
        told = guard.judge(tracking, {"controller": asked})
        if refused:
            assert told is not None
            assert told.startswith(f"{name} margin {np.floor(has * 100.0) / 100.0:g} < ")
            assert told.endswith(f"{unit} at T_s 50 us")
        else:
            assert told is None


def test_gains_that_go_together_are_judged_together(tracking):
    alone = gains(tracking, m=20000.0)
    together = gains(tracking, m=20000.0, P=0.0004)
    assert guard.judge(tracking, {"controller": alone}) is not None
    assert guard.judge(tracking, {"controller": together}) is None


def test_what_makes_it_no_worse_is_taken(tracking):
    running = {"controller": gains(tracking, P=0.01)}
    better = {"controller": gains(tracking, P=0.009)}
    assert guard.judge(tracking, better) is not None
    assert guard.judge(tracking, better, running) is None


@pytest.mark.parametrize("strict", ["off", "warn", "refuse"])
def test_how_strict_it_is_the_controller_says(tracking, strict):
    running = {node: tracking.nodes[node].params for node in config.NODES}
    running["controller"] = gains(tracking, **{"tuning.guard": strict})
    new = changed(SCHEMAS["controller"], running["controller"], {"P": 0.01})
    said = []

    def ask():
        guard.guard(tracking, running, "controller", new, said.append)

    if strict == "refuse":
        with pytest.raises(ParameterError, match=r"^gain margin 0\.55 < 1\.3 at T_s 50 us \(at "):
            ask()
    else:
        ask()
    assert len(said) == (strict == "warn")


def test_an_observer_is_judged_with_the_running_law(tracking):
    running = {node: tracking.nodes[node].params for node in config.NODES}
    wrong = changed(SCHEMAS["observer"], running["observer"], {"K": 0.05})
    with pytest.raises(ParameterError, match="gain margin"):
        guard.guard(tracking, running, "observer", wrong, print)


# The command line


@pytest.mark.parametrize(
    ("texts", "said"),
    [(["P"], "write NAME=VALUE"), (["=1"], "write NAME=VALUE"), (["P=1", "P=2"], "twice")],
)
def test_assignments_of_another_form_are_refused(texts, said):
    with pytest.raises(ParameterError, match=said):
        param_cli.assignments(texts)


def test_assignments_have_the_types_that_people_mean():
    texts = ["P=0.001", "type=pid", "feedforward=false", "D_c=1e-8", "seed=-5", "taps=[0.5, 1]"]
    found = param_cli.assignments(texts)
    assert found == {"P": 0.001, "type": "pid", "feedforward": False, "D_c": 1e-8, "seed": -5,
                     "taps": [0.5, 1]}  # fmt: skip
    assert type(found["seed"]) is int


def test_rqt_reconfigure_can_show_every_number():
    """It needs a finite range for each, of integers one of 32 bits, and reads no other."""
    shown = [*map(specs, (LoopParams, RecorderParams))]
    for schema in SCHEMAS.values():
        kinds = getattr(schema, "kinds", {})
        shown += [specs(schema, {"type": kind}) for kind in kinds] or [specs(schema)]
    for name, spec in (each for known in shown for each in known.items()):
        described = descriptor(spec)
        for span in described.integer_range:
            assert -(2**31) <= span.from_value < span.to_value < 2**31, name
        if spec.kind is float:
            (span,) = described.floating_point_range
            assert np.isfinite([span.from_value, span.to_value]).all(), name


def test_nodes_go_by_their_short_and_full_names():
    assert param_cli.role("/pea/controller") == param_cli.role("controller") == "controller"
    with pytest.raises(ParameterError, match="did you mean controller"):
        param_cli.role("controler")


def test_a_file_that_names_a_preset_asks_for_its_values(tmp_path):
    file = tmp_path / "p.yaml"
    config.write(file, {"controller": {"preset": "recommended", "P": 0.001}})
    found = param_cli.wanted(str(file))
    assert list(found) == ["controller"]
    assert (found["controller"]["P"], found["controller"]["m"]) == (0.001, 5000.0)


def test_only_what_differs_is_different():
    running = {"P": 0.001, "type": "pid", "feedforward": True, "gains": (1.0,), "m": 2.0}
    asked = {"P": "1e-3", "type": "pid", "feedforward": False, "gains": [1.0], "m": 2, "x": 1}
    running["tuning.guard"], asked["tuning.guard"] = "off", config.parse("off")
    assert param_cli.differences(running, asked) == {"feedforward": (True, False), "x": (None, 1)}


def test_running_nodes_are_asked_set_saved_and_loaded(ros, tmp_path):
    def pea(*arguments):
        done = subprocess.run(
            [sys.executable, "-m", "pea_cli.cli", "param", *arguments],
            cwd=tmp_path,
            env=ros.env,
            capture_output=True,
            text=True,
            timeout=60,
        )
        return done.returncode, done.stdout, done.stderr

    ros.start("controller", *tracking_arguments())
    ros.says("controller", "waiting for")
    assert json.loads(pea("get", "controller", "P", "--json")[1]) == {"controller": {"P": 0.0004}}
    assert pea("set", "controller", "P=0.0005", "I=2", "--as", "alice")[0] == 0
    assert "changed_by = /pea/alice" in pea("get", "controller")[1]
    status, _, err = pea("set", "controller", "P=0.0006", "I=-1")
    assert (status, err.count("\n")) == (2, 1)
    assert "/pea/controller refuses: " in err
    assert pea("set", "controller", "P=high")[2] == "pea: controller.P = 'high': give a number\n"
    assert pea("get", "controller", "P")[1] == "0.0005\n"
    assert pea("set", "controller", "tuning.guard=off")[0] == 0
    assert pea("get", "controller", "tuning.guard")[1] == "off\n"
    assert pea("set", "controller", "type=pid", "K_p=2")[0] == 0
    told = pea("list", "controller")[1].split()
    assert "K_p" in told
    assert "P" not in told
    assert pea("save", "all.yaml", "--node", "controller")[0] == 0
    for place in ("all.yaml", "no/where.yaml"):  # there already; nowhere
        status, _, err = pea("save", place)
        assert (status, err.count("\n"), place in err) == (2, 1, True)
    assert pea("set", "controller", "K_p=3")[0] == 0
    status, table, _ = pea("diff", "all.yaml")
    assert status == 3
    assert "controller.K_p" in table
    assert pea("load", "all.yaml")[1] == "/pea/controller: 1 changed\n"
    assert pea("diff", "all.yaml")[:2] == (0, "the same\n")


def tracking_arguments():
    path = config.find("experiments", "fig9_hysteresis_10hz", "experiment")
    return ("--ros-args", "--params-file", str(path))
