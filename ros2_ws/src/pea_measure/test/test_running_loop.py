"""T, S, L and margins of a running loop beside theory: two laws, noise and hysteresis on."""

import numpy as np
import pytest

from pea_core.loop import blocks_of, trace
from pea_measure import analysis, loop_response, plans

SHORT = {"period": 0.05, "from_hz": 20.0, "periods": 3}


def measured(preset, where):
    base = plans.Base("sine_series", (f"controller.preset={preset}", "plant.seed=3"))
    made = plans.injected(base, "loop", None, {"where": where, **SHORT})
    plant = made.experiment.nodes["plant"].params
    assert plant.sensor.noise_nm > 0.0
    assert plant.creep.enabled
    assert type(plant.hysteresis).__module__.endswith("prandtl_ishlinskii")
    loop = made.experiment.loop()
    samples = trace([loop.run(n) for n in blocks_of(made.experiment.samples, loop.piece)])
    return analysis.of(made, samples)


def curve(found, name):
    told = found["curves"][name]
    radius = np.array([np.inf if r is None else r for r in told["radius_95"]])
    return np.array(told["real"]) + 1j * np.array(told["imag"]), radius


@pytest.mark.parametrize(("preset", "where"), [("pid", "voltage"), ("recommended", "reference")])
def test_theory_lies_within_the_stated_intervals(preset, where, monkeypatch):
    monkeypatch.setattr(loop_response, "DRAWS", 100)
    found = measured(preset, where)
    S, _ = curve(found, "S_plant")
    for name, theory in (("S", S), ("T", 1.0 - S), ("L", 1.0 / S - 1.0)):
        G, radius = curve(found, name)
        assert np.mean(np.abs(G - theory) <= radius) >= 0.9, name
    rows = found["margins"]
    known = [r for r in rows.values() if r["measured"] is not None and r.get("predicted_plant")]
    assert len(known) >= 2
    apart = [abs(r["measured"] - r["predicted_plant"]) for r in known]
    width = [max(r["high_95"] - r["measured"], r["measured"] - r["low_95"]) for r in known]
    assert (np.array(apart) <= 2.0 * np.array(width)).all()
    # one table: measured, its interval, predicted on the nominal plant and on this one
    table = analysis.margin_table(found)
    assert {len(row) for row in table} == {6}
    assert len(table) == len(analysis.MARGINS)


def test_the_bandwidth_measured_is_beyond_the_first_resonance(monkeypatch):
    monkeypatch.setattr(loop_response, "DRAWS", 100)
    base = plans.Base("resonant", ("controller.preset=resonant_fast",))
    signal = {"period": 0.02, "from_hz": 50.0, "to_hz": 2500.0, "periods": 2, "realisations": 3}
    made = plans.injected(base, "loop", None, signal)
    loop = made.experiment.loop()
    samples = trace([loop.run(n) for n in blocks_of(made.experiment.samples, loop.piece)])
    found = analysis.of(made, samples)["margins"]
    assert found["bandwidth_hz"]["low_95"] >= 739.0
    assert found["modulus"]["low_95"] >= 0.5
