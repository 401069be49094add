"""What the dashboard is made of, without a browser."""

import asyncio
import contextlib
import io
import json
import os
import signal
import socket
import subprocess
import sys
import threading
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.signal
import yaml

from pea_cli import cli
from pea_core.block import changed
from pea_core.loop import blocks_of
from pea_core.params import ParameterError, Spec, build, flatten, specs
from pea_core.signals import SAMPLE
from pea_dashboard import child, stop, stop_server, tuning
from pea_dashboard.child import RunPlan
from pea_dashboard.door import Door, DoorMiddleware
from pea_dashboard.link import End, Link, ParameterChange
from pea_dashboard.recording import RecordedTrace
from pea_dashboard.trace import Trace, path
from pea_dashboard.truth import Effect, TruthFollower
from pea_dashboard.window import (
    View,
    along,
    chosen,
    density,
    look,
    pack,
    response,
    running_rms,
    spectrum,
)
from pea_engine.kernels import drive_kernel
from pea_experiment import experiments, metrics
from pea_experiment.experiment import SCHEMAS
from pea_record.bag import BagWriter
from pea_record.origin import ORIGIN, origin
from pea_record.rows import NOTHING, ahead, record
from pea_report.replay import retune
from pea_wire import convert
from pea_wire.topics import DISPLACEMENT, STATE, VOLTAGE

T_NS = 50_000


def put(trace, start, rows, *sources, T_ns=T_NS):
    """Give samples of a run from `start` on, as they come from the topics."""
    stamps = (start + np.arange(len(rows))) * T_ns
    for source in sources or ("reference", "displacement", "state", "voltage"):
        trace.put(source, stamps, {name: rows[name] for name in rows.dtype.names})


def sine(n, frequency=10.0):
    t = np.arange(n) * T_NS * 1e-9
    rows = np.zeros(n, SAMPLE)
    rows["w"] = 5e-6 * np.sin(2 * np.pi * frequency * t)
    rows["y"] = rows["w"] + 3e-9 * np.sin(2 * np.pi * 400.0 * t)
    rows["u"] = rows["w"] / 0.142e-6
    return rows


def test_a_sample_is_there_when_all_of_it_has_come():
    trace = Trace(2**14)
    rows = sine(100)
    put(trace, 0, rows, "displacement", "state")
    assert trace.end == 0
    put(trace, 0, rows[:60], "voltage")
    assert (trace.first, trace.end) == (0, 60)
    assert np.isnan(trace.samples(0, 60, "w")["w"]).all()  # the reference was sent before
    put(trace, 0, rows, "reference")
    np.testing.assert_array_equal(trace.samples(0, 60, "w")["w"], rows["w"][:60])


def test_memory_is_bounded_and_what_is_old_goes():
    trace = Trace(2**14)
    rows = sine(1000)
    for start in range(0, 100_000, 1000):
        put(trace, start, rows)
    assert trace.end == 100_000
    assert trace.end - trace.first < 2**14
    found = trace.samples(0, 10**9)
    assert found["k"][0] == trace.first
    np.testing.assert_array_equal(found["y"][-1000:], rows["y"])


def test_a_hole_is_told_and_shown_as_one():
    trace = Trace(2**14)
    put(trace, 0, sine(100))
    put(trace, 150, sine(50))
    assert trace.unseen == 50
    assert np.isnan(trace.samples(100, 150, "y")["y"]).all()
    assert trace.unbroken == 150


def test_a_new_run_begins_anew():
    trace = Trace(2**14)
    put(trace, 5000, sine(100))
    run = trace.run
    put(trace, 0, sine(200))
    assert (trace.run > run, trace.first, trace.end) == (True, 0, 200)


def test_a_window_keeps_a_spike_and_tells_the_rms():
    trace = Trace()
    rows = sine(100_000)
    rows["u"][77_777] += 500.0
    put(trace, 0, rows)
    found = look(trace, View(span=2.0), period=0.1)
    assert found["arrays"]["u"].max() > 400.0
    assert len(found["arrays"]["t"]) < 5000
    assert found["rms_nm"] == pytest.approx(3.0 / np.sqrt(2.0), rel=1e-6)
    assert found["t0"] == pytest.approx(3.0)


def test_a_window_of_the_past_is_given_whole():
    trace = Trace()
    put(trace, 0, sine(100_000))
    found = look(trace, View(span=0.05, end=4.0))
    assert found["t0"] + found["span"] == pytest.approx(4.0)
    assert len(found["arrays"]["t"]) == 1000


def test_the_spectrum_tells_the_amplitude_of_a_sine():
    t = np.arange(2**15) * 50e-6
    f, amplitude = spectrum(7.0 * np.sin(2 * np.pi * 312.0 * t) + 100.0, 50e-6)
    assert amplitude.max() == pytest.approx(7.0, rel=0.05)
    assert f[amplitude.argmax()] == pytest.approx(312.0, rel=0.03)


def test_the_density_of_white_noise_is_that_of_its_spread():
    e = np.random.default_rng(1).normal(0.0, 2.0, 2**15)
    f, found = density(e, 50e-6)
    assert np.median(found[f > 1000.0]) == pytest.approx(2.0 * np.sqrt(2.0 * 50e-6), rel=0.3)


@pytest.mark.parametrize("excited", [10.0, 150.0, 700.0])
def test_a_response_is_told_where_the_reference_excites_the_loop(excited):
    t = np.arange(2**15) * 50e-6
    b, a = scipy.signal.butter(2, 800.0, fs=20_000.0)
    w = np.sin(2 * np.pi * excited * t) + 0.3 * np.sin(2 * np.pi * 40.0 * t)
    noise = np.random.default_rng(2).normal(0.0, 1e-3, len(t))
    f, T, S = response(w, scipy.signal.lfilter(b, a, w) + noise, 50e-6)
    at = np.abs(f - excited).argmin()
    _, (exact,) = scipy.signal.freqz(b, a, [f[at]], fs=20_000.0)
    assert f[at] == pytest.approx(excited, abs=3.0)
    assert T[at] == pytest.approx(abs(exact), rel=0.02)
    assert S[at] == pytest.approx(abs(1.0 - exact), rel=0.1, abs=0.01)
    assert not ((f > 1000.0) | ((f > 250.0) & (f < 500.0))).any()  # nobody has asked there


def test_the_running_rms_is_that_of_the_samples_before():
    e = np.random.default_rng(1).normal(size=500)
    e[100] = np.nan
    rms = running_rms(e, 50)
    assert np.isnan(rms[:49]).all()
    assert np.isnan(rms[100:150]).all()
    assert rms[300] == pytest.approx(np.sqrt(np.mean(e[251:301] ** 2)))


def test_a_frame_is_read_as_its_head_says():
    data = pack({"run": 3}, {"t": np.arange(3.0), "y": np.ones(2)})
    size = int.from_bytes(data[:4], "little")
    head = json.loads(data[4 : 4 + size])
    assert size % 4 == 0
    assert head == {"run": 3, "arrays": {"t": 3, "y": 2}}
    assert np.frombuffer(data[4 + size :], "<f4").tolist() == [0.0, 1.0, 2.0, 1.0, 1.0]


# The path of several axes


def circle(n, axes):
    """Wanted and measured positions of some axes (m): a circle, and errors of a few nm."""
    t = np.arange(n) * T_NS * 1e-9
    w = np.array([5e-6 * np.sin(2 * np.pi * 10.0 * t + i) for i in range(len(axes))]).T
    return w, w + 3e-9 * np.cos(2 * np.pi * 400.0 * t)[:, None]


@pytest.mark.parametrize("axes", [("x",), ("x", "y"), ("tip", "tilt", "piston")])
def test_messages_of_all_axes_make_the_path_and_the_trace_of_one(axes):
    link = object.__new__(Link)
    link.namespace, link.trace, link.axis = "/pea", Trace(2**14), axes[-1]
    link.forget()
    forms, n = convert.forms(axes), 40
    w, y = circle(n, axes)
    zero = [0.0] * len(axes) if len(axes) > 1 else [0.0]
    stamps = np.arange(n) * T_NS
    shaped = w if len(axes) > 1 else w[:, 0]
    rows = forms.reference.encode_each(stamps, shaped, shaped, shaped)
    link.points(convert.encode_block(rows.itemsize, rows.tobytes()))
    for source, topic, fields in (
        ("displacement", DISPLACEMENT, lambda k: [y[k], zero]),
        ("state", STATE, lambda k: [zero] * 3),
        ("voltage", VOLTAGE, lambda k: [zero]),
    ):
        codec = forms.codecs[topic][0]
        data = [
            codec.encode(int(t), *(each if len(axes) > 1 else each[0] for each in fields(k)))
            for k, t in enumerate(stamps)
        ]
        link.block(source, convert.encode_block(len(data[0]), b"".join(data)))
    found = link.trace.samples(0, n)
    np.testing.assert_array_equal(found["y"], y[:, -1])
    np.testing.assert_array_equal(found["w"], w[:, -1])
    assert (link.path is None) == (len(axes) == 1)
    if link.path is not None:
        found = link.path.samples(0, n)
        for i, axis in enumerate(axes):
            np.testing.assert_array_equal(found[f"{axis}.w"], w[:, i])
            np.testing.assert_array_equal(found[f"{axis}.y"], y[:, i])


@pytest.mark.parametrize("axes", [("x", "y"), ("tip", "tilt", "piston")])
def test_a_path_has_all_its_axes_and_hides_no_extreme(axes):
    w, y = circle(60_000, axes)
    trace, whole = Trace(), path(axes)
    rows = np.zeros(len(w), SAMPLE)
    put(trace, 0, rows)
    spike = 41_234
    y[spike, 1] += 40e-9
    y[spike + 300, 0] = np.nan
    stamps = np.arange(len(w)) * T_NS
    for source, values in (("reference", w), ("displacement", y)):
        whole.put(source, stamps, dict(zip(whole.sources[source], values.T)))
    found = along(trace, whole, View(span=2.0), chosen(axes, View()))
    error = (found["y1"] - found["w1"]) * 1e3
    assert error.max() == pytest.approx(40.0, abs=3.1)
    assert len(found) == 2 * len(axes)
    assert all(len(values) < 12_000 for values in found.values())
    assert [found[f"y{i}"][-1] for i in range(2)] == pytest.approx(1e6 * y[-1, :2])  # now


def test_the_axes_of_a_path_are_chosen():
    axes = ("a", "b", "c", "d")
    assert chosen(("x",), View()) == ()
    assert chosen(axes, View()) == ("a", "b", "c")
    assert chosen(axes, View(path=("d", "b"))) == ("d", "b")
    for odd in (("d",), ("d", "d"), ("d", "z"), ("z",)):  # of another loop
        assert chosen(axes, View(path=odd)) == ("a", "b", "c")


@pytest.fixture(scope="module")
def bag_of_three(tmp_path_factory):
    """A recording of three axes of which the first two move."""
    there = tmp_path_factory.mktemp("recorded") / "bag"
    sets = ["axes=[tip, tilt, piston]", "reference.tilt.frequency_hz=20"]
    sets += [
        "reference.piston.amplitude_um=0",
        "plant.stage.permitted_um=[-9,-9,19,-9,19,19,-9,19]",
    ]
    experiment = experiments.load_axes("fig9_hysteresis_10hz", sets, 0.1)
    loop = experiment.loop()
    with BagWriter(there, T_NS) as bag:
        sections = experiment.sections()
        bag.metadata(ORIGIN, origin(experiment.name, sections, "batch", T_NS))
        for samples in blocks_of(2000, 500):
            k = loop.k
            rows = loop.run(samples)
            last = ahead(loop) if loop.k == 2000 else NOTHING
            record(bag, k, T_NS, rows, last, experiment.axes)
    return there


def test_a_recording_of_several_axes_has_one_of_them_and_the_path(bag_of_three):
    recorded = RecordedTrace(bag_of_three)
    assert (recorded.axes, recorded.axis) == (("tip", "tilt", "piston"), "tip")
    found = along(recorded, recorded, View(span=0.05), recorded.axes)
    of_tilt = RecordedTrace(bag_of_three, "tilt")
    y = of_tilt.samples(1000, 2000, "y")["y"]
    assert (found["y1"].min(), found["y1"].max()) == pytest.approx((y.min() * 1e6, y.max() * 1e6))
    assert recorded.permitted[:2] == (-9.0, -9.0)
    assert recorded.limits is not None


# What only the simulation knows


def simulated(samples, *sets):
    sets = ("observer.type=extended_state", "plant.sensor.ideal=false", *sets)
    experiment = experiments.load("fig9_hysteresis_10hz", sets)
    loop = experiment.loop()
    rows = np.concatenate([loop.run(500) for _ in range(samples // 500)])
    return experiment, rows, {node: dict(each.values) for node, each in experiment.nodes.items()}


@pytest.mark.parametrize("joined", [0, 700])
def test_the_truth_is_found_also_when_somebody_joins_late(joined, monkeypatch):
    monkeypatch.setenv("PEA_COMPILE", "0")
    experiment, rows, values = simulated(2000)
    trace = Trace(2**14)
    truth = TruthFollower(trace)
    put(trace, joined, rows[joined:], "displacement", "state", "voltage")  # and no reference
    while truth.follow(values):
        pass
    assert truth.lost == ""
    expected = metrics.truth(experiment.plant(), rows, experiment.nominal)["eps"][joined:]
    found = trace.samples(joined, 2000, "eps", "w")
    np.testing.assert_array_equal(found["eps"], expected)
    np.testing.assert_array_equal(found["w"], rows["w"][joined:])


def test_the_truth_loads_compiled_code_once_and_not_with_each_block(monkeypatch):
    pytest.importorskip("numba")
    monkeypatch.setenv("PEA_COMPILE", "1")
    made = []

    def spy(model):
        made.append(model)
        return drive_kernel(model)

    monkeypatch.setattr("pea_dashboard.truth.drive_kernel", spy)
    _, rows, values = simulated(1000)
    trace = Trace(2**14)
    truth = TruthFollower(trace)
    for start in range(0, 1000, 100):
        put(trace, start, rows[start : start + 100])
        assert truth.follow(values)
    assert truth.lost == ""
    assert len(made) == 1


def test_the_truth_is_found_again_behind_a_lost_block_and_a_changed_gain(monkeypatch):
    monkeypatch.setenv("PEA_COMPILE", "0")
    experiment, _, values = simulated(500)
    loop, effect = experiment.loop(), Effect(300, "controller", {"P": 0.0002, "changed_by": "/me"})
    before = loop.run(effect.k).copy()
    retune(loop.controller, effect.role, effect.values)
    rows = np.concatenate([before, loop.run(700)])
    trace = Trace(2**14)
    truth = TruthFollower(trace)
    put(trace, 0, rows[:500])
    assert truth.follow(values, [effect])
    put(trace, 600, rows[600:])
    while truth.follow(values, [effect]):
        pass
    assert truth.lost == ""
    expected = metrics.truth(experiment.plant(), rows, experiment.nominal)["eps"][600:]
    np.testing.assert_array_equal(trace.samples(600, 1000, "eps")["eps"], expected)


def test_no_truth_is_told_of_a_plant_that_is_another(monkeypatch):
    monkeypatch.setenv("PEA_COMPILE", "0")
    _, rows, values = simulated(1000)
    values["plant"]["K"] = 0.15
    trace = Trace(2**14)
    truth = TruthFollower(trace)
    put(trace, 0, rows)
    truth.follow(values)
    assert "y differs" in truth.lost
    assert np.isnan(trace.samples(0, 1000, "eps")["eps"]).all()


def test_a_node_that_has_ended_is_not_there_though_its_name_is_kept():
    link = object.__new__(Link)
    link.namespace = "/pea"
    link.nodes = ["/pea/plant", "/pea/observer"]
    link.ends = [End("/pea/displacement", (), ()), End("/pea/state", ("observer",), ())]
    assert link.there == ["observer"]


# Tuning


class Nodes:
    """In place of the link: takes values, as nodes do."""

    def __init__(self, refuse=""):
        self.sets = []
        self.refuse = refuse

    def set(self, role, values):
        if role == self.refuse:
            raise ParameterError(f"/pea/{role} refuses")
        self.sets.append((role, dict(values)))


@pytest.fixture
def tuned():
    _, _, values = simulated(500, "controller.preset=recommended")
    made = tuning.Tuning()
    made.rest_on(values, live=True)
    return made


def test_the_margin_is_told_before_anything_is_applied(tuned):
    tuned.think("controller", {"P": 0.002})
    good = tuned.judge()
    tuned.think("controller", {"P": 0.02})
    bad = tuned.judge()
    assert (good.level, bad.level) == ("good", "bad")
    assert "gain margin" in bad.text
    assert tuned.base["controller"]["P"] == 0.0012


def test_a_value_out_of_range_is_not_even_thought_of(tuned):
    with pytest.raises(ParameterError, match=r"controller\.m = -5"):
        tuned.think("controller", {"m": -5.0})
    assert tuned.changes == {}


def test_all_is_applied_or_nothing(tuned):
    tuned.think("observer", {"omega_o": 15000.0})
    tuned.think("controller", {"P": 0.001, "I": 5.0})
    nodes = Nodes(refuse="controller")
    with pytest.raises(ParameterError, match="controller refuses"):
        tuned.apply(nodes)
    assert nodes.sets == [
        ("observer", {"omega_o": 15000.0}),
        ("observer", {"omega_o": 20000.0}),
    ]
    assert set(tuned.changes) == {"observer", "controller"}
    nodes = Nodes()
    tuned.apply(nodes)
    assert nodes.sets[1] == ("controller", {"P": 0.001, "I": 5.0})
    assert tuned.changes == {}


def test_undo_takes_back_one_change_after_the_other(tuned):
    nodes = Nodes()
    for before, after in ((0.0012, 0.001), (0.001, 0.0008)):
        tuned.changed(
            tuning.ParameterChange("controller", {"P": before}, {"P": after}, "/pea/alice", 1.0)
        )
    for expected in (0.001, 0.0012):
        tuned.undo(nodes)
        assert nodes.sets[-1] == ("controller", {"P": expected})
        tuned.changed(
            tuning.ParameterChange("controller", {}, {"P": expected}, "/pea/dashboard", 2.0)
        )
    with pytest.raises(ParameterError, match="nothing to undo"):
        tuned.undo(nodes)
    assert [c.author for c in tuned.history[:2]] == ["/pea/alice", "/pea/alice"]


def test_undo_brings_back_the_law_before_with_its_gains(tuned):
    schema, before = SCHEMAS["controller"], dict(tuned.base["controller"])
    law = build(schema, {name: value for name, value in before.items() if name != "T_s"})
    tuned.preset("controller", "precise")
    other = changed(schema, law, tuned.draft["controller"])
    after = flatten(schema, other)
    tuned.rest_on({**tuned.base, "controller": after}, live=True)
    tuned.changed(ParameterChange("controller", before, after, "", 1.0))
    nodes = Nodes()
    tuned.undo(nodes)
    ((node, values),) = nodes.sets
    assert node == "controller"
    assert changed(schema, other, values) == law
    assert not {name for name in values if specs(schema, after).get(name, Spec()).fixed}


def test_another_law_that_is_thought_of_has_all_its_values(tuned):
    tuned.think("controller", {"type": "predictive"})
    values = tuned.values("controller")
    assert values["learning_rate"] == 0.2
    assert all(name in values for name in tuned.specs("controller"))


def test_a_preset_may_bring_another_law(tuned):
    tuned.preset("controller", "pid")
    assert tuned.draft["controller"]["type"] == "pid"
    assert "K_p" in tuned.specs("controller")
    assert tuned.judge().text


def test_what_was_tuned_is_kept_when_a_run_ends(tuned):
    before = {node: dict(values) for node, values in tuned.base.items()}
    for old, new in ((0.0012, 0.001), (0.001, 0.0008)):
        tuned.changed(ParameterChange("controller", {"P": old}, {"P": new}, "", 1.0))
    tuned.changed(ParameterChange("observer", {"omega_o": 20000.0}, {"omega_o": 9000.0}, "", 2.0))
    tuned.changed(ParameterChange("observer", {"omega_o": 9000.0}, {"omega_o": 20000.0}, "", 3.0))
    after = {**before, "controller": {**before["controller"], "P": 0.0008}}
    tuned.rest_on(after, live=True)
    assert tuned.tuned == {"controller": {"P": 0.0008}}
    kept = tuned.tuned
    tuned.rest_on(before, live=False)
    tuned.keep(kept)
    assert tuned.kept == tuned.changes == {"controller": {"P": 0.0008}}
    assert tuned.over({"controller.m": 5000.0})["controller.P"] == 0.0008
    tuned.rest_on(after, live=True)  # it was there all the same
    assert (tuned.kept, tuned.changes) == ({}, {})
    tuned.rest_on(before, live=False)
    tuned.keep(kept)
    tuned.forget()
    assert (tuned.kept, tuned.changes) == ({}, {})


def test_what_is_thought_of_is_saved_as_a_preset_and_read_again(tuned, tmp_path):
    tuned.think("controller", {"P": 0.0008})
    path = tuned.save(tmp_path / "presets", "mine")
    written = yaml.safe_load(path.read_text())["/pea/controller"]["ros__parameters"]
    assert written["P"] == 0.0008
    sets = [f"{node}.preset={path}" for node in ("controller", "observer")]
    again = experiments.load("fig9_hysteresis_10hz", sets)
    for node in ("controller", "observer"):
        now = again.nodes[node].values
        thought = tuned.values(node)
        assert all(now[n] == thought[n] for n in thought if n in written)
    tuned.forget()
    tuned.preset("controller", str(path))
    assert tuned.changes == {"controller": {"P": 0.0008}}
    with pytest.raises(ParameterError, match="exists already"):
        tuned.save(tmp_path / "presets", "mine")


@pytest.mark.parametrize("name", ["", "../mine", "a b", "1st", "x" * 61, "ä"])
def test_a_preset_has_a_plain_name(tuned, tmp_path, name):
    with pytest.raises(ParameterError, match="must have 1 to 60 letters"):
        tuned.save(tmp_path, name)
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def reported(monkeypatch):
    """`pea report` in this process; what it was asked."""
    asked = []

    def run(command, **options):
        words = command[command.index("report") :]
        asked.append(words)
        told = io.StringIO()
        with contextlib.redirect_stdout(told), contextlib.redirect_stderr(errors := io.StringIO()):
            cli.main(words)
        return SimpleNamespace(
            stdout=told.getvalue().encode(), stderr=errors.getvalue().encode(), returncode=0
        )

    monkeypatch.setattr(child.subprocess, "run", run)
    return asked


def test_a_run_that_was_stopped_has_metrics_and_a_report(reported, tmp_path, monkeypatch):
    page, figures = tmp_path / "analysis.html", {"rms_error_nm": 1.5}

    def main(words):
        page.write_text("a report")
        print(json.dumps({"html": str(page), "metrics": {words[1]: figures}}))

    monkeypatch.setattr(cli, "main", main)
    made = child.Child(0)
    made.process = made
    made.score(made, tmp_path)
    assert json.loads((tmp_path / "metrics.json").read_text()) == figures
    assert made.report == str(page.resolve())
    made.score(made, tmp_path)  # it has them
    assert len(reported) == 1


def test_what_cannot_be_scored_says_why(reported, tmp_path):
    made = child.Child(0)
    made.process, made.outcome = made, "ended"
    made.score(made, tmp_path)
    assert made.report == ""
    assert made.outcome.startswith("ended; no report: ")


def test_a_plan_says_what_pea_run_is_told(monkeypatch):
    monkeypatch.setattr(child, "loop_core", lambda: None)
    plan = RunPlan("sine_series", duration=5.0, record=False, sets={"controller.D_c": 1e-8})
    told = "run sine_series --mode composed --clock wall --duration 5.0 --no-record --set"
    assert plan.arguments == [*told.split(), "controller.D_c=1.0e-08"]


def test_what_was_typed_behind_set_is_passed_on(monkeypatch):
    monkeypatch.setattr(child, "loop_core", lambda: None)
    typed = ["observer.type=extended_state", "plant.sensor.ideal=false", "controller.m=5000"]
    typed += ["reference.amplitudes_um=[1, 2.5]"]
    parsed = experiments.parse_set(typed)
    sets = {f"{node}.{name}": v for node, each in parsed.items() for name, v in each.items()}
    assert set(RunPlan("sine_series", sets=sets).assignments) == set(typed)


# Who may come in


def test_this_machine_alone_needs_no_token():
    door = Door("127.0.0.1", 8642)
    assert door.open_to({"host": "127.0.0.1:8642"})
    assert door.open_to({"host": "localhost:8642", "origin": "http://localhost:8642"})
    assert not door.open_to({"host": "127.0.0.1:8642", "origin": "http://elsewhere.example"})
    assert not door.open_to({"host": "127.0.0.1:8642", "origin": "http://127.0.0.1:9000"})
    assert door.open_to({"host": "127.0.0.1:8643", "origin": "http://127.0.0.1:8642"})  # the stop
    assert door.open_to({"host": "localhost:9000", "origin": "http://localhost:9000"})  # a tunnel
    assert not door.open_to({"host": "elsewhere.example:8642"})  # a name bent to this machine


def test_from_elsewhere_the_token_is_needed():
    door = Door("0.0.0.0", 8642)
    assert len(door.token) >= 16
    host = {"host": "rig.example:8642"}
    assert not door.open_to(host)
    assert not door.open_to(host, "token=wrong")
    assert not door.open_to({**host, "cookie": "pea_token=wrong"})
    assert door.open_to(host, f"token={door.token}")
    assert door.open_to({**host, "cookie": f"pea_token={door.token}"})
    assert not door.open_to(
        {**host, "cookie": f"pea_token={door.token}", "origin": "http://elsewhere.example"}
    )


@pytest.fixture(scope="module")
def served():
    """A stop's server, and what was asked of it."""
    asked = []

    def halt():
        asked.append("stop")
        return stop.EmergencyStopped(True, "stopped")

    server = stop_server.Server(stop_server.listen("127.0.0.1", 0), halt, Door("127.0.0.1", 8642))
    with stop_server.serving(server):
        yield server.port, asked


def sent(port, data):
    """What is answered to bytes, until the connection ends."""
    with socket.create_connection(("127.0.0.1", port), timeout=10) as connection:
        connection.sendall(data)
        return b"".join(iter(lambda: connection.recv(65536), b""))


def post(port, body=b"", path="/stop", **headers):
    headers = {"Host": f"127.0.0.1:{port}", "Content-Length": len(body), **headers}
    lines = "".join(f"{name.replace('_', '-')}: {value}\r\n" for name, value in headers.items())
    return f"POST {path} HTTP/1.1\r\n{lines}\r\n".encode() + body


def test_the_stop_is_served_by_a_thread_of_its_own(served):
    port, asked = served
    asked.clear()
    assert b" 403 " in sent(port, post(port, Origin="http://elsewhere.example"))
    assert asked == []
    head, _, body = sent(port, post(port, Connection="close")).partition(b"\r\n\r\n")
    assert b" 200 " in head
    assert json.loads(body) == {"safe": True, "text": "stopped"}
    assert asked == ["stop"]


@pytest.mark.parametrize("size", [0, 1024, 1025, 70_000, 2_000_000])
@pytest.mark.parametrize("told", ["all", "less", "none", "chunked"])
def test_no_body_of_another_page_is_taken_for_a_request(served, size, told):
    port, asked = served
    asked.clear()
    inner = post(port)
    body = b"x" * size + inner
    headers = {"Origin": "http://elsewhere.example", "Content_Type": "text/plain"}
    lengths = {"all": len(body), "less": size, "none": 0, "chunked": 0}
    data = post(port, body, **headers, Content_Length=lengths[told])
    if told == "chunked":
        framed = b"%x\r\n%s\r\n0\r\n\r\n" % (len(body), body)
        data = post(port, **headers, Transfer_Encoding="chunked")
        data = data.replace(b"Content-Length: 0\r\n", b"") + framed
    with contextlib.suppress(OSError):  # it may be cut while it still sends
        assert b" 200 " not in sent(port, data)
    assert asked == []


@pytest.mark.parametrize(
    "headers",
    [
        {"Origin": "null"},
        {"Origin": "http://127.0.0.1:9000"},
        {"Origin": "http://elsewhere.example, http://127.0.0.1:8642"},
        {"Host": "elsewhere.example:8642"},
        {"Host": "localhost.elsewhere.example"},
        {"Sec_Fetch_Site": "cross-site", "Sec_Fetch_Mode": "no-cors"},
        {"Sec_Fetch_Site": "same-site", "Sec_Fetch_Mode": "no-cors"},
        {
            "Sec_Fetch_Site": "cross-site",
            "Sec_Fetch_Mode": "navigate",
            "Sec_Fetch_Dest": "document",
        },
        {"Content_Length": 2**20 + 1},
        {"Content_Length": "1" * 5000},
    ],
    ids=str,
)
def test_what_another_page_can_send_does_not_stop(served, headers):
    port, asked = served
    asked.clear()
    assert b" 200 " not in sent(port, post(port, **headers))
    assert asked == []


def test_the_stop_has_a_page_of_its_own_that_nobody_may_frame(served):
    port, asked = served
    page = sent(port, b"GET / HTTP/1.0\r\nHost: localhost:%d\r\n\r\n" % port)
    assert b" 200 " in page
    assert b"frame-ancestors 'none'" in page
    assert f'name="pea-stop-port" content="{port}"'.encode() in page
    assert asked == []


def test_a_page_that_fails_still_has_the_stop():
    async def fails(scope, receive, send):
        raise RuntimeError("no page")

    told = []

    async def send(message):
        told.append(message)

    scope = {"type": "http", "method": "GET", "path": "/", "query_string": b""}
    scope["headers"] = [(b"host", b"127.0.0.1:8642")]
    word = stop_server.bare(8643, "This page cannot be shown ({{error}})")
    app = DoorMiddleware(fails, Door("127.0.0.1", 8642), word)
    with pytest.raises(RuntimeError):
        asyncio.run(app(scope, None, send))
    assert told[0]["status"] == 500
    assert b'content="8643"' in told[1]["body"]
    assert b"RuntimeError" in told[1]["body"]


class Plant:
    """Answers of a plant, one after the other; an exception ends it, None is no answer."""

    def __init__(self, monkeypatch, answers, ends="ended", found=True):
        self.answers, self.calls, self.ended = list(answers), 0, []
        self.made = object.__new__(stop.Stop)
        self.made.domain, self.made.namespace = 1, "/pea"
        self.made.one = threading.Lock()
        self.made.clients = {"stop": self}
        self.made.call = self.ask
        monkeypatch.setattr(stop, "ANSWER", 0.2)
        monkeypatch.setattr(stop, "RAMP", 0.2)
        monkeypatch.setattr(stop, "AGAIN", 0.0)
        there = [stop.PlantProcess(7, "run"), stop.PlantProcess(8, "plant")] if found else []
        monkeypatch.setattr(stop, "processes", lambda domain, namespace: there)

        def end(process):
            self.ended.append(process.kind)
            return ends

        monkeypatch.setattr(stop, "end", end)

    def service_is_ready(self):
        return bool(self.answers)

    def ask(self, name):
        self.calls += 1
        answer = self.answers.pop(0) if len(self.answers) > 1 else (self.answers or [None])[0]
        if isinstance(answer, Exception):
            self.answers = []
            return None
        if answer is None and self.answers:
            return stop.EmergencyStopped(False, "/pea/plant/stop does not answer within 0.2 s")
        return None if answer is None else stop.EmergencyStopped(*answer, True)


RAMPS = (True, "/pea/plant/stop: fault: emergency_stop; 40.0 V, on the way to 0 V")
RESTS = (True, "/pea/plant/stop: fault: emergency_stop; 0 V")
LOST = (False, "/pea/plant/stop: fault: driver; the device is not reached")


def test_a_stop_asks_until_the_stage_has_its_safe_voltage(monkeypatch):
    plant = Plant(monkeypatch, [RAMPS, RAMPS, LOST, RAMPS, RESTS])
    assert plant.made()[:2] == RESTS
    assert plant.calls == 5
    assert plant.ended == []


@pytest.mark.parametrize(
    ("answers", "ends", "first", "safe"),
    [
        ([RAMPS], "ended", "plant", True),  # it ramps down as it ends
        ([RAMPS], "killed", "plant", False),
        ([None], "ended", "plant", True),
        ([None], "killed", "plant", False),
        ([RAMPS, None], "does not end", "plant", False),
        ([LOST], "ended", "plant", False),
        ([RAMPS, OSError()], "ended", "plant", True),  # a loop in one process ends after its trip
        ([], "ended", "run", True),  # simulated
        ([], "killed", "run", False),
    ],
    ids=str,
)
def test_a_stop_that_reaches_nothing_ends_the_process_and_says_what_is_not_known(
    answers, ends, first, safe, monkeypatch
):
    plant = Plant(monkeypatch, answers, ends)
    done = plant.made()
    assert plant.ended == [first]
    assert done.safe is safe
    assert ("may not be safe" in done.text) is not safe
    assert ends in done.text


def test_a_service_that_is_discovered_late_is_waited_for(monkeypatch):
    class Late(Plant):
        looks = 0

        def service_is_ready(self):
            self.looks += 1
            self.answers = [RESTS] if self.looks > 3 else []
            return bool(self.answers)

    plant = Late(monkeypatch, [])
    assert plant.made()[:2] == RESTS
    assert plant.ended == []


def test_where_nothing_runs_there_is_nothing_to_stop(monkeypatch):
    assert Plant(monkeypatch, [], found=False).made() == (True, "nothing runs here", False)
    lost = Plant(monkeypatch, [None], found=False).made()
    assert not lost.safe
    assert "its process is not found; the stage may not be safe" in lost.text


@pytest.mark.parametrize(
    ("ignores", "how"), [(False, "ended"), (True, "killed")], ids=["obeys", "hangs"]
)
def test_a_plant_that_does_not_answer_is_ended_by_signal(ignores, how, monkeypatch):
    monkeypatch.setitem(stop.END, "plant", 1.0)
    words = "import signal,time;"
    words += "signal.signal(signal.SIGINT, signal.SIG_IGN);" if ignores else ""
    words += "print(1, flush=True);time.sleep(60)"
    process = subprocess.Popen(
        [sys.executable, "-c", words, "/install/lib/pea_plant/plant"],
        env={**os.environ, "ROS_DOMAIN_ID": "199"},
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    try:
        assert process.stdout.readline() == b"1\n"
        assert stop.processes(198) == []
        assert stop.processes(199, "/stage1") == []
        (found,) = stop.processes(199)
        assert found == (process.pid, "plant")
        assert stop.end(found) == how
    finally:
        process.kill()
        process.wait()
        process.stdout.close()
