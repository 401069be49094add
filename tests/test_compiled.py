"""The compiled loop and plain Python are the same to the bit, whatever the blocks."""

import numpy as np
import pytest

from pea_core.loop import LoopFault
from pea_core.signals import Reference
from pea_engine.compiled import WORTH, wanted
from pea_experiment import experiments
from pea_experiment.metrics import truth

NOISY = (
    "plant.sensor.noise_nm=0.7",
    "plant.delay_samples=1",
    "plant.creep.enabled=true",
    "controller.preset=recommended",
)
OBSERVED = ("observer.type=extended_state", *NOISY)
SETTINGS = {
    "paper": (),
    "preisach": ("plant.hysteresis.type=preisach", "observer.type=kalman", *NOISY),
    "every block of the amplifier and the sensor": (
        "observer.type=levant",
        "plant.amplifier.bandwidth_hz=3000",
        "plant.amplifier.slew_rate=50000",
        "plant.amplifier.dac_bits=16",
        "plant.sensor.bandwidth_hz=5000",
        "plant.sensor.quantisation_nm=0.1",
        "plant.sensor.delay_samples=1",
        *NOISY,
    ),
    "limits": ("plant.voltage_min=0", "plant.voltage_max=90", "reference.phase_deg=-90"),
    "gate": (
        "plant.safety.slew_rate=20000",
        "plant.safety.displacement_max_um=5.5",
        *OBSERVED,
    ),
}
SAMPLES = 900


def run(experiment, compiled, pieces):
    loop = experiment.loop(compiled)
    rows = np.concatenate([loop.run(n) for n in pieces])
    return loop, rows


@pytest.mark.parametrize("setting", SETTINGS)
def test_compiled_and_plain_loops_give_the_same_bits(setting):
    experiment = experiments.load("fig9_hysteresis_10hz", SETTINGS[setting])
    _, plain = run(experiment, False, [SAMPLES])
    _, compiled = run(experiment, True, [1, 99, SAMPLES - 100])
    assert compiled.tobytes() == plain.tobytes()


def test_the_gate_trips_at_the_same_sample_compiled_and_plain():
    experiment = experiments.load("fig9_hysteresis_10hz", SETTINGS["gate"])
    trips = {run(experiment, compiled, [SAMPLES])[0].plant.trip for compiled in (False, True)}
    (trip,) = trips
    assert trip.startswith("displacement_range at sample ")


def test_an_idle_gate_changes_no_bit():
    limits = ("plant.safety.slew_rate=1e9", "plant.safety.beyond=1e3")
    _, without = run(experiments.load("fig9_hysteresis_10hz", OBSERVED), True, [SAMPLES])
    _, within = run(experiments.load("fig9_hysteresis_10hz", (*OBSERVED, *limits)), True, [SAMPLES])
    assert within.tobytes() == without.tobytes()


def test_truth_is_the_same_compiled_and_plain(monkeypatch):
    experiment = experiments.load("fig9_hysteresis_10hz", SETTINGS["preisach"])
    _, rows = run(experiment, False, [SAMPLES])
    found = []
    for switch in "01":
        monkeypatch.setenv("PEA_COMPILE", switch)
        found.append(truth(experiment.plant(), rows, experiment.nominal))
    assert found[0].tobytes() == found[1].tobytes()


def test_truth_is_not_told_where_the_plant_was_another():
    experiment = experiments.load("fig9_hysteresis_10hz")
    _, rows = run(experiment, False, [50])
    other = experiments.load("fig9_hysteresis_10hz", ["plant.hysteresis.type=none"])
    assert truth(other.plant(), rows, other.nominal) is None


@pytest.mark.parametrize("compiled", [False, True])
def test_a_change_of_parameters_between_samples_is_bumpless_and_alike(compiled):
    experiment = experiments.load("fig9_hysteresis_10hz", OBSERVED)
    loop, before = run(experiment, compiled, [500])
    params = loop.controller.params
    loop.controller.retune(type(params)(**{**vars(params), "m": 9000.0, "I": 2.0}))
    after = loop.run(100)
    assert abs(after["u"][0] - before["u"][-1]) < 1.0
    plain = experiment.loop()
    plain.run(500)
    plain.controller.retune(loop.controller.params)
    assert plain.run(100).tobytes() == after.tobytes()


@pytest.mark.parametrize("compiled", [False, True])
def test_a_command_that_is_no_number_ends_the_loop_and_keeps_what_came_before(compiled):
    experiment = experiments.load("fig9_hysteresis_10hz")
    loop = experiment.loop(compiled)
    first = loop.run(10)
    c = loop.controller.c
    loop.controller.c = c._replace(c=c.c._replace(m=float("nan")))
    rows = loop.run(10)
    assert (len(first), len(rows), loop.k) == (10, 0, 10)
    assert isinstance(loop.fault, LoopFault)
    assert str(loop.fault).startswith("voltage at sample 10 is nan")


def test_long_runs_are_compiled_short_ones_are_not_and_the_switch_decides(monkeypatch):
    monkeypatch.delenv("PEA_COMPILE", raising=False)
    assert wanted(WORTH)
    assert not wanted(WORTH - 1)
    monkeypatch.setenv("PEA_COMPILE", "0")
    assert not wanted(10**9)
    monkeypatch.setenv("PEA_COMPILE", "1")
    assert wanted(1)


def test_reference_points_are_the_same_compiled_and_plain():
    from pea_engine.kernels import reference_kernel

    experiment = experiments.load("fig9_hysteresis_10hz", ["reference.type=chirp"])
    signal = experiment.loop().reference
    points = np.empty((200, 3))
    reference_kernel(signal.model)(signal.c, 7000, points)
    assert points.tobytes() == np.array([signal.at(7000 + i) for i in range(200)]).tobytes()
    assert isinstance(signal.at(0), Reference)


def test_compiled_code_tells_every_model_from_every_other():
    pytest.importorskip("numba")
    from pea_controller import model as controllers
    from pea_engine.cells import Like
    from pea_observer import model as observers

    for models in (observers.MODELS, controllers.MODELS):
        designed = [model.design(model.Params(), 50e-6) for model in models.values()]
        begun = [model.start(c) for model, c in zip(models.values(), designed, strict=True)]
        for values in (designed, begun):
            kept = [Like((value,)) for value in values]
            assert len({like.kind for like in kept}) == len({type(value) for value in values})
