"""A test signal in a running loop: theory's sensitivity, any mode, on and off live, in replay."""

import numpy as np
import pytest

from pea_controller import model as controllers
from pea_core.block import changed
from pea_core.injection import signal
from pea_core.live import FADE, LAW, Live
from pea_core.loop import blocks_of, trace
from pea_core.params import ParameterError, build
from pea_core.signals import Estimate, Reference
from pea_experiment import experiments
from pea_lab.check import response
from pea_lab.linear import assemble, blocks
from pea_lab.sweep import simulate
from pea_record.read import load
from pea_report.recorded import experiment_of
from pea_report.replay import replay

T_S = 50e-6
SHORT = ("wait=0.02", "period=0.02", "from_hz=50", "realisations=1", "periods=1")


def injected(preset, *more, hysteresis="none", duration=0.09):
    sets = ("reference.type=constant", f"plant.hysteresis.type={hysteresis}", "plant.K=0.142")
    sets += ("plant.sensor.noise_nm=0", "plant.creep.enabled=false")
    sets += tuple(f"controller.inject.{one}" for one in (*SHORT, *more))
    return experiments.load(
        "sine_series", [*sets, f"controller.preset={preset}"], duration=duration
    )


def run(experiment):
    loop = experiment.loop()
    return trace([loop.run(n) for n in blocks_of(experiment.samples, loop.piece)])


@pytest.mark.parametrize("preset", ["recommended", "precise", "pid", "disturbance_observer"])
def test_at_the_voltage_it_shows_the_sensitivity_of_theory(preset):
    experiment = injected(preset, "where=voltage")
    plan, d = signal(experiment.nodes["controller"].params, T_S)
    u = run(experiment)["u"]
    D, U = (np.fft.rfft(plan.measured(x)[:, 0, 0, 0])[plan.lines[0]] for x in (d, u))
    omega_T = 2.0 * np.pi * plan.lines[0] / plan.N
    L = -response(assemble(blocks(experiment)), omega_T)
    np.testing.assert_allclose(U / D, 1.0 / (1.0 + L), rtol=2e-4)


def test_at_the_reference_the_stage_follows_it():
    experiment = injected("recommended", "where=reference", "to_hz=200", "amplitude_um=0.1")
    plan, d = signal(experiment.nodes["controller"].params, T_S)
    y = run(experiment)["y"]
    D, Y = (np.fft.rfft(plan.measured(x)[:, 0, 0, 0])[plan.lines[0]] for x in (d, y))
    assert np.abs(Y / D - 1.0).max() < 0.01  # the feedforward is exact on this plant


def test_a_reference_out_of_reach_is_refused():
    with pytest.raises(ParameterError, match="outside the stroke"):
        injected("recommended", "where=reference", "amplitude_um=9")


W, X = Reference(1e-6, 0.0, 0.0), Estimate(1e-6, 0.0, 0.0)


def on(**values):
    asked = {"where": "voltage", "period": 0.02, **values}
    return {f"inject.{n}": v for n, v in asked.items()}


def live(kind="pidsmc"):
    return Live(controllers.MODELS, build(controllers.CHOICE, {"type": kind}), T_S, LAW)


def told(block, n):
    found = []
    for _ in range(n):
        found.append(block.output(W, W, X))
        block.update()
    return np.array(found)


@pytest.mark.parametrize("kind", controllers.MODELS)
@pytest.mark.parametrize("where", ["voltage", "reference"])
def test_switched_on_and_off_the_voltage_does_not_step(kind, where):
    block, without = live(kind), live(kind)
    told(block, 50)
    told(without, 50)
    block.retune(changed(controllers.CHOICE, block.planned, on(where=where, to_hz=500.0)))
    assert told(block, 1) == pytest.approx(told(without, 1), abs=1e-9)
    difference = np.abs(told(block, 990) - told(without, 990)).max()
    if hasattr(controllers.MODELS[kind], "switching"):  # its voltage steps anyway
        return
    assert difference > 0.1
    gap = told(block, 2) - told(without, 2)
    block.retune(changed(controllers.CHOICE, block.planned, {"inject.where": "off"}))
    after = told(block, 1) - told(without, 1)
    assert after == pytest.approx(gap[-1:], abs=3.0 * abs(np.diff(gap)[0]) + 1e-3)
    told(block, round(FADE / T_S) + 1)
    assert block.s.left == 0


def test_it_goes_on_where_other_values_change_and_begins_anew_where_its_own_do():
    block = live()
    told(block, 1)
    block.retune(changed(controllers.CHOICE, block.planned, on()))
    told(block, 300)
    block.retune(changed(controllers.CHOICE, block.planned, {"P": 0.0011}))
    told(block, 1)
    assert block.s.k == 301
    block.retune(changed(controllers.CHOICE, block.planned, {"inject.seed": 1}))
    told(block, 1)
    assert block.s.k == 1


def test_the_law_is_told_its_own_command():
    block, alone = live("predictive"), live("predictive")
    told(block, 1)
    told(alone, 1)
    block.retune(changed(controllers.CHOICE, block.planned, on()))
    told(block, 300)
    told(alone, 300)
    assert block.s.s.eps == pytest.approx(alone.s.s.eps, abs=1e-9)


@pytest.mark.parametrize("where", ["voltage", "reference"])
def test_every_mode_has_the_same_bits_and_replays(recorded, where):
    arguments = ["sine_series", "--duration", "0.05"]
    for one in (*SHORT, f"where={where}"):
        arguments += ["--set", f"controller.inject.{one}"]
    digests = set()
    for mode in (
        ("batch", "composed", "distributed") if where == "voltage" else ("batch", "composed")
    ):
        run = recorded(mode, *arguments)
        recording = load(run.directory)
        again = replay(recording, experiment_of(recording, run.directory), run.directory)
        assert again.first is None
        digests.add(run.metrics["trace_sha256"])
    assert len(digests) == 1
    assert digests.isdisjoint({recorded("batch", *arguments[:3]).metrics["trace_sha256"]})


def test_a_sweep_refuses_it():
    with pytest.raises(ParameterError, match="a sweep injects nothing"):
        simulate("sine_series", sets=["controller.inject.where=voltage"], progress=False)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        (("where=volt",), "controller.inject.where = 'volt': did you mean voltage?"),
        (("where=voltage", "to_hz=20000"), "inject.to_hz = 20000: must be below half the sample"),
        (("where=reference", "amplitude_um=nan"), "inject.amplitude_um = 'nan': must be finite"),
    ],
)
def test_bad_values_are_one_line(start_pea, values, words):
    sets = [part for one in values for part in ("--set", f"controller.inject.{one}")]
    found = start_pea("run", "sine_series", *sets).finish()
    assert (found.status, len(found.err.splitlines())) == (2, 1)
    assert words in found.err
