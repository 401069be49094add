"""A sweep's runs are those of batch mode, to the bit, whatever varies and whatever the blocks."""

import math
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from pea import simulate
from pea_controller.model import pidsmc
from pea_core.loop import blocks_of, trace
from pea_core.params import ParameterError
from pea_experiment import experiments
from pea_experiment.metrics import metrics, truth

PAGE = Path(__file__).parent.parent / "docs" / "sweeps.md"
NAME = "fig9_hysteresis_10hz"
DURATION = 0.06  # 1200 samples: more than one piece of a kernel, and a part of one
NOISY = (
    "plant.sensor.ideal=false",
    "plant.sensor.noise_nm=0.7",
    "plant.delay_samples=1",
    "plant.creep.enabled=true",
)
BLOCKS = {
    "paper": (),
    "long arrays, a load, a late sensor, modes": (
        *NOISY,
        "plant.hysteresis.type=preisach",
        "plant.sensor.delay_samples=50",
        "plant.load.type=sine",
        "plant.vibration.type=modal",
        "observer.type=kalman",
        "controller.type=state_feedback",
    ),
}
SIGNALS = ("w", "y", "u_applied", "x1_hat", "x2_hat", "eps_hat", "u")


def batch(sets):
    """Samples, truth and metrics of one run of batch mode's loop."""
    experiment = experiments.load(NAME, sets, DURATION)
    loop = experiment.loop()
    rows = trace([loop.run(n) for n in blocks_of(experiment.samples)])
    true = truth(experiment.plant(), rows, experiment.nominal)
    plant = experiment.nodes["plant"].params
    figures = metrics(rows, true, experiment.segments, plant.voltage_min, plant.voltage_max)
    return rows, true, figures


def alike(sweep, run, sets):
    rows, true, figures = batch(sets)
    for name in SIGNALS:
        assert sweep[name][run].tobytes() == np.ascontiguousarray(rows[name]).tobytes(), name
    for name in ("x1", "x2", "eps"):
        assert sweep[name][run].tobytes() == np.ascontiguousarray(true[name]).tobytes(), name
    for name, values in sweep.metrics.items():
        assert values[run] == pytest.approx(figures[name], rel=1e-9, abs=1e-12), name


@pytest.mark.parametrize("blocks", BLOCKS)
def test_a_run_of_a_sweep_has_the_bits_and_the_metrics_of_batch_mode(blocks):
    vary = {
        "plant.K": np.linspace(0.13, 0.15, 18),
        "plant.seed": range(7, 25),
        "controller.zeta": 0.8,
    }
    keep = (*SIGNALS, "x1", "x2", "eps")
    sweep = simulate(NAME, vary, sets=BLOCKS[blocks], duration=DURATION, keep=keep, progress=False)
    assert sweep.runs == 18
    assert sweep["y"].shape == (18, 1200)
    for run in (0, 15, 17):  # first and last lane of a full kernel, last of a part of one
        sets = [f"{name}={sweep[name][run]}" for name in vary]
        alike(sweep, run, [*BLOCKS[blocks], *sets])


def test_plain_python_and_lanes_give_the_same_bits(monkeypatch):
    vary = {"plant.zeta": [0.8, 0.85], "reference.frequency_hz": [20.0, 40.0]}
    found = []
    for switch in ("0", "1"):
        monkeypatch.setenv("PEA_COMPILE", switch)
        found.append(simulate(NAME, vary, duration=DURATION, keep=["y", "u"], progress=False))
    for name in ("y", "u", *found[0].metrics):
        assert found[0][name].tobytes() == found[1][name].tobytes(), name
    assert not np.array_equal(found[0]["y"][0], found[0]["y"][1])


def test_types_presets_and_what_follows_the_plant_vary_too():
    vary = {
        "controller.preset": ["paper_set1", "paper_set2"] * 2,
        "plant.voltage_max": [1000.0, 1000.0, 900.0, 900.0],
    }
    sweep = simulate(NAME, vary, duration=DURATION, keep=["y"], progress=False)
    for run in (0, 3):
        rows, *_ = batch([f"{name}={values[run]}" for name, values in vary.items()])
        assert sweep["y"][run].tobytes() == np.ascontiguousarray(rows["y"]).tobytes()


def test_a_type_that_varies_comes_with_its_own_preset():
    """Nothing of the preset that the experiment names is left, also of the same type."""
    vary = {"controller.type": ["pidsmc", "pid"]}
    found = simulate("fig9_hysteresis_10hz", vary, duration=0.05, progress=False)
    assert found["rms_error_nm"] == pytest.approx([13.09146572, 14.17852885], abs=5e-9)
    vary = {"controller.preset": ["recommended", "pid"]}
    presets = simulate("fig9_hysteresis_10hz", vary, duration=0.05, progress=False)
    assert found["rms_error_nm"].tobytes() == presets["rms_error_nm"].tobytes()


def test_a_run_without_a_finite_command_is_told_and_spoils_no_other(monkeypatch):
    design = pidsmc.design

    def broken(params, T_s):
        return design(params, T_s)._replace(m=math.nan if params.P == 1.0 else params.m)

    monkeypatch.setattr(pidsmc, "design", broken)
    vary = {"controller.P": [0.001, 1.0]}
    sweep = simulate(NAME, vary, duration=DURATION, keep=["u"], progress=False)
    assert sweep.failed_at.tolist() == [-1, 0]
    assert np.isnan(sweep["u"][1]).all()
    assert np.isnan(sweep["rms_error_nm"][1])
    rows, *_ = batch(["controller.P=0.001"])
    assert sweep["u"][0].tobytes() == np.ascontiguousarray(rows["u"]).tobytes()


@pytest.mark.parametrize(
    ("vary", "options", "told"),
    [
        ({"plant.K": [0.1, 0.2], "plant.seed": [1]}, {}, "plant.K has 2, plant.seed has 1"),
        ({"plant.k": [0.1, 0.2]}, {}, "run 0: unknown parameter plant.k"),
        ({"plant.K": [0.142, -1.0]}, {}, "run 1: plant.K = -1.0"),
        ({"plant.K": [0.142, 0.001]}, {}, "run 1: reference from"),
        ({"plant.T_s": [1e-4]}, {}, "cannot vary"),
        ({}, {"keep": ["z"]}, "unknown signal 'z'"),
        ({"plant.K": []}, {}, "there is no run"),
        ({"plant.K": [0.1, 0.2]}, {"sets": ["plant.K=0.142"]}, "vary plant.K and sets plant.K"),
        ({"plant.seed": 3}, {"sets": ["plant.K=0.142", "plant.seed=4"]}, "sets plant.seed"),
        ({"controller.type": ["pid"]}, {"sets": ["controller.type=smc"]}, "sets controller.type"),
    ],
)
def test_bad_input_is_named_in_one_line(vary, options, told):
    with pytest.raises(ParameterError, match=re.escape(told)):
        simulate(NAME, vary, duration=DURATION, progress=False, **options)


def test_units_and_a_table_come_with_the_figures():
    sweep = simulate(NAME, {"plant.K": [0.14, 0.142]}, duration=DURATION, progress=False)
    assert sweep.units["plant.K"] == "um/V"
    assert sweep.units["rms_error_nm"] == "nm"
    table = sweep.frame()
    assert table["plant.K"].tolist() == [0.14, 0.142]
    assert len(table["rms_error_nm"]) == 2
    with pytest.raises(KeyError, match="rms_error_nm"):
        sweep["rms_error"]


def test_the_example_of_the_page_runs_and_shows_progress():
    (text,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.S)
    told = subprocess.run(
        [sys.executable, "-c", text], capture_output=True, text=True, timeout=240, check=True
    )
    assert re.match(r"rms error \d+\.\d+ nm, 90 % of 200 within", told.stdout)
    assert "200/200" in told.stderr


TWO = ("axes=[x, y]", "plant.stage.cross_talk=[0, 0.05, 0.02, 0]", "reference.y.frequency_hz=20")


def test_a_run_of_two_axes_has_the_bits_and_the_metrics_of_batch_mode():
    sets, K = [*TWO, *NOISY, "observer.type=extended_state"], [0.13, 0.14]
    keep = ("y", "u", "x1")
    sweep = simulate(
        NAME, {"plant.y.K": K}, sets=sets, duration=DURATION, keep=keep, progress=False
    )
    assert sweep.units["plant.y.K"] == "um/V"
    for run, value in enumerate(K):
        experiment = experiments.load_axes(NAME, [*sets, f"plant.y.K={value}"], DURATION)
        loop = experiment.loop()
        rows = trace([loop.run(n) for n in blocks_of(experiment.samples)])
        true = truth(experiment.plant(), rows, tuple(one.nominal for one in experiment.each))
        squares = 0.0
        for i, (axis, one) in enumerate(zip(experiment.axes, experiment.each, strict=True)):
            for name, source in (("y", rows), ("u", rows), ("x1", true)):
                kept = sweep[f"{axis}.{name}"][run]
                assert kept.tobytes() == np.ascontiguousarray(source[name][:, i]).tobytes()
            limits = [
                getattr(one.nodes["plant"].params, f"voltage_{end}") for end in ("min", "max")
            ]
            figures = metrics(rows[:, i], true[:, i], one.segments, *limits)
            squares += figures["rms_error_nm"] ** 2
            for name in ("rms_error_nm", "eps_max_V", "observer_rms_x1_nm"):
                assert sweep[f"{axis}.{name}"][run] == figures[name]
        assert sweep["rms_error_nm"][run] == pytest.approx(math.sqrt(squares), rel=1e-12)


@pytest.mark.parametrize(
    ("vary", "message"),
    [
        ({"plant.z.K": [0.13, 0.14]}, "run 0: unknown parameter plant.z.K"),
        ({"plant.y.K": [0.14, -1.0]}, "run 1: plant.y.K"),
        ({"plant.axes": ["[x, y]", "[x, y, z]"]}, "axes"),
    ],
)
def test_a_sweep_of_axes_names_the_run_that_is_refused(vary, message):
    with pytest.raises(ParameterError, match=re.escape(message)):
        simulate(NAME, vary, sets=TWO, duration=0.01, progress=False)


RAW = ["reference.type=step", "reference.offset_um=0", "plant.amplifier.slew_rate=40000"]


@pytest.mark.parametrize(
    ("experiment", "vary", "sets", "named"),
    [
        (NAME, {"controller.type": ["pidsmc", "open_loop"]}, RAW, r"^run 1: .*raw step of 5 um"),
        (
            NAME,
            {"plant.amplifier.slew_rate": [0.0, 8e4]},
            [*RAW[:2], "controller.type=open_loop"],
            r"^run 1: .*= 80000 V/s leaves",
        ),
        ("raster_xy", {"controller.y.preset": ["open_loop"]}, RAW, r"^raster_xy: axis y: .*leaves"),
    ],
)
def test_a_raw_step_that_is_not_held_is_refused(experiment, vary, sets, named):
    with pytest.raises(ParameterError, match=named):
        simulate(experiment, vary, sets=sets, duration=DURATION, progress=False)


def test_a_raw_step_that_is_not_held_is_run_where_it_is_forced():
    sets = [*RAW, "controller.type=open_loop"]
    found = simulate(NAME, sets=sets, duration=0.001, progress=False, force=True)
    assert found.failed_at[0] == -1
