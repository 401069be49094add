"""The logic of the bench; no figure of time is judged."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from pea_bench import batch, distributed, hand, hardware, page, recorder
from pea_bench.plan import QUICK
from pea_bench.rows import KEYS, Part, Row, best, figures, interleaved, keep, kept, ratio, worse
from pea_cli import bench as bench_cli
from pea_core.loop import LoopFault, blocks_of, trace
from pea_run.deadlines import Deadlines

TINY = QUICK._replace(
    rounds=2,
    samples=200,
    python_samples=20,
    opensmc_steps=20,
    plants=3,
    plant_samples=100,
    messages=8000,
    naive_messages=80,
    paced_s=0.1,
    durations=(0.005, 0.01),
    sweeps=(1, 2),
)


def row(value, name="batch.ratio_vs_opensmc", demand=">= 100"):
    return Row(name, "", "", (value,), demand)


# Rows


def test_a_figure_is_the_median_with_the_extremes():
    of_three = Row("batch.us_per_step", "", "us", (3.0, 1.0, 8.0))
    assert of_three.value == 3.0
    assert of_three.spread == (1.0, 8.0)


def test_what_was_not_measured_has_no_figure():
    missing = Row("batch.opensmc_us_per_step", "", "us", (), ">= 1")
    assert (missing.value, missing.spread, missing.fine) == (None, None, None)


@pytest.mark.parametrize(
    ("demand", "value", "fine"),
    [("<= 2", 2.0, True), ("<= 2", 2.1, False), (">= 10", 10.0, True), (">= 10", 9.0, False)],
)
def test_a_demand_is_met_or_not(demand, value, fine):
    assert row(value, demand=demand).fine is fine


def test_rounds_are_interleaved_there_and_back():
    calls = []
    ticks = []
    jobs = {name: lambda name=name: calls.append(name) or len(calls) for name in "abc"}
    found = interleaved(jobs, 3, lambda: ticks.append(1))
    assert calls == [*"abc", *"cba", *"abc"]
    assert found == {"a": (1, 6, 7), "b": (2, 5, 8), "c": (3, 4, 9)}
    assert len(ticks) == 9


def test_the_best_is_the_least():
    values = iter([3.0, 1.0, 2.0])
    assert best(lambda: next(values)) == 1.0


def test_ratios_are_of_the_same_round():
    assert ratio((10.0, 30.0), (2.0, 3.0)) == (5.0, 10.0)
    assert ratio((), (2.0, 3.0)) == ()
    assert ratio((1.0, 4.0), (0.0, 2.0)) == (2.0,)


# Figures kept


def test_json_has_every_key_and_no_other():
    told = figures([row(7.0), Row("batch.ratio_vs_hand", "", "", (1.0,))], KEYS)
    assert told.keys() == KEYS.keys()
    assert {name: tuple(part) for name, part in told.items()} == KEYS
    assert told["batch"]["ratio_vs_opensmc"] == 7.0
    assert told["startup"] == {"distributed_s": None, "batch_s": None}


@pytest.mark.parametrize(
    ("demand", "then", "now", "told"),
    [
        (">= 100", 200.0, 150.0, False),
        (">= 100", 200.0, 141.0, False),
        (">= 100", 200.0, 139.0, True),
        ("<= 2", 1.0, 1.29, False),
        ("<= 2", 1.0, 1.4, True),
        ("<= 2", 1.0, 0.2, False),
    ],
)
def test_a_ratio_worse_by_a_third_is_told(demand, then, now, told):
    assert bool(worse([row(now, demand=demand)], [row(then, demand=demand)])) is told


def test_times_and_what_is_missing_are_not_compared():
    slow = Row("startup.batch_s", "", "s", (9.0,), "<= 2.5")
    assert worse([slow], [slow._replace(values=(1.0,))]) == []
    assert worse([row(1.0)], []) == []
    assert worse([row(1.0)._replace(values=())], [row(9.0)]) == []


def test_kept_parts_come_back_and_are_replaced_one_by_one(tmp_path):
    path = tmp_path / "performance.json"
    assert kept(path) == {}
    one = Part([row(300.0)], {"plants": [[1, 0.5]]}, ["a note"])
    keep(path, {"batch": one}, {"date": "today"})
    keep(path, {"recorder": Part([], {}, [])}, {"date": "later"})
    assert kept(path) == {"batch": one, "recorder": Part([], {}, [])}
    assert json.loads(path.read_text())["machine"] == {"date": "later"}


# Measures


def test_the_loop_by_hand_is_the_loop_of_the_blocks():
    made = batch.experiment(0.1)
    loop = made.loop()
    blocks = trace([loop.run(n) for n in blocks_of(made.samples)])
    rows = np.full((made.samples, 10), np.inf)
    hand.by_hand(hand.coefficients(made), made.plant().noise(made.samples), rows)
    for i, name in enumerate(blocks.dtype.names):
        scale = np.nanmax(np.abs(blocks[name])) if name != "y_dot" else 1.0
        np.testing.assert_allclose(rows[:, i], blocks[name], rtol=0.0, atol=1e-9 * scale)


def test_batch_measures_all_but_the_peer_where_that_is_missing(monkeypatch, tmp_path):
    monkeypatch.setattr(batch, "PEER", tmp_path / "none")
    monkeypatch.setattr(batch, "sweep", lambda plants, samples: 0.1)  # tests of its own
    monkeypatch.setattr(hand, "compiled", lambda: hand.by_hand)
    ticks = []
    part = batch.measure(TINY, lambda: ticks.append(1))
    told = figures(part.rows, ["batch"])["batch"]
    peer = {name for name in told if "opensmc" in name}
    assert {name for name, value in told.items() if value is None} == peer
    assert all(value > 0.0 for name, value in told.items() if name not in peer)
    assert part.notes == [batch.MISSING]
    assert len(ticks) == batch.steps(TINY)
    assert [d for d, _ in part.curves["duration"]] == [0.005, 0.01]


@pytest.mark.skipif(not batch.PEER.exists(), reason=batch.MISSING)
def test_the_peer_runs():
    assert batch.opensmc(20) > 0.0


def test_recorder_reads_back_what_it_wrote():
    part = recorder.measure(TINY, lambda: None)
    told = figures(part.rows, ["recorder"])["recorder"]
    assert told["lost"] == 0
    assert None not in told.values()


def test_a_message_that_is_missing_counts_as_lost(tmp_path):
    stamps, signals = recorder.samples(100)
    ours = recorder.Blocks(tmp_path / "a.mcap")
    ours.write(np.delete(stamps, 50), np.delete(signals, 50, axis=1))
    ours.close()
    assert (
        recorder.lost(tmp_path / "a.mcap", 100) == 8
    )  # the missing one and its follower, 4 topics


def test_steady_rate_leaves_the_start_out():
    told = [(0.0, 0), (5.0, 100), (6.0, 300), (7.0, 400), (8.0, 500)]
    assert distributed.steady(told) == pytest.approx(400 / 3)


def test_rounds_in_wall_time_are_pooled():
    one, other, whole = Deadlines(50_000), Deadlines(50_000), Deadlines(50_000)
    rng = np.random.default_rng(1)
    for each, late in ((one, 1000), (other, 60_000)):
        times = np.sort(rng.integers(0, late, (500, 2)))
        each.add(times)
        whole.join(each)
    assert whole.samples == 1000
    assert whole.missed == one.missed + other.missed > 0
    assert whole.missed_fraction == whole.missed / 1000
    assert whole.latest == other.latest
    assert one.quantile(0.5) < whole.quantile(0.5) < other.quantile(0.5)
    us, later = np.array(whole.tail()).T
    assert np.all(np.diff(us) > 0)
    assert np.all(np.diff(later) < 0)
    assert later[-1] == 0.0


def on_a_device(missed, lost=0, samples=100):
    deadlines = Deadlines(50_000)
    times = np.zeros((samples, 2), np.int64)
    times[:missed] = 30_000, 90_000
    deadlines.add(times)
    return hardware.Found(deadlines, 2.5, 9.0, lost)


def test_a_loop_on_a_device_is_compared_with_the_same_exchange_alone(monkeypatch):
    calls = []

    def loop(name, seconds, sets=()):
        calls.append((name, *sets))
        return on_a_device(4, 20, 80)  # what a halt has left out counts as missed

    monkeypatch.setattr(hardware, "loop", loop)
    monkeypatch.setattr(hardware, "empty", lambda name, seconds: on_a_device(12))
    monkeypatch.setattr(
        hardware, "graph", lambda name, seconds, sets=(): 0.25 if "T_s=0.001" in sets else 0.5
    )
    ticks = []
    part = hardware.measure(TINY._replace(device_rounds=2), lambda: ticks.append(1))
    told = figures(part.rows, ["hardware"])["hardware"]
    assert None not in told.values()
    assert told["udp_missed_ratio"] == told["registers_missed_ratio"] == pytest.approx(2.0)
    assert told["registers_exchange_us_p50"] == 2.5
    assert 30.0 <= told["udp_lateness_us_p999"] <= 31.0
    assert (told["graph_late_1khz"], told["graph_late_2khz"]) == (0.25, 0.5)
    assert told["composed_missed_1khz"] == pytest.approx(0.24)
    assert len(ticks) == hardware.steps(TINY._replace(device_rounds=2)) == 2 * 8
    assert calls.count(("board_emulated",)) == 2
    demands = {row.name: row.fine for row in part.rows if row.demand}
    assert demands["hardware.udp_missed_ratio"] is True
    assert demands["hardware.registers_missed_ratio"] is False


def test_a_round_that_trips_is_begun_anew_and_told(monkeypatch):
    fails = iter([LoopFault("clock: 0.3 s"), None, *[LoopFault("clock: 0.3 s")] * 9])

    def loop(name, seconds, sets=()):
        if name == "board_emulated" and (fault := next(fails)):
            raise fault
        return on_a_device(1)

    monkeypatch.setattr(hardware, "loop", loop)
    monkeypatch.setattr(hardware, "empty", lambda name, seconds: on_a_device(0))
    monkeypatch.setattr(hardware, "graph", lambda name, seconds, sets=(): 0.5)
    part = hardware.measure(TINY, lambda: None)
    rows = {row.name: row.value for row in part.rows}
    assert rows["hardware.trips"] == 1
    assert rows["hardware.udp_missed_ratio"] is None  # the empty loop has missed nothing
    assert part.notes == ["Tripped, and begun anew: clock: 0.3 s."]
    part = hardware.measure(TINY, lambda: None)  # it trips whenever it is tried
    rows = {row.name: row for row in part.rows}
    assert rows["hardware.trips"].value == hardware.TRIES
    assert rows["hardware.udp_missed_fraction"].values == ()
    assert rows["hardware.udp_lateness_us_p999"].values == ()
    assert rows["hardware.graph_late_2khz"].values == (0.5,)


# Page


@pytest.fixture
def there(monkeypatch, tmp_path):
    for name, file in (("KEPT", "p.json"), ("PAGE", "p.md"), ("FIGURES", "p")):
        monkeypatch.setattr(page, name, tmp_path / file)
    return tmp_path


PARTS = {
    "batch": Part(
        [row(250.0), Row("batch.us_per_step", "one run", "us", (0.1, 0.2, 0.3))],
        {"duration": [(1.0, 0.1), (2.0, 0.2)], "plants": [(1, 0.2), (10, 0.05)]},
        ["a note"],
    ),
    "distributed": Part([], {"axes": [(1, 2e4), (2, 1e4)]}, []),
    "composed": Part(
        [row(3.0, "composed.missed_ratio_vs_empty", "<= 1.5")],
        {
            "lateness": {"loop": [(1.0, 0.5), (9.0, 0.0)], "empty loop": [(1.0, 0.4), (5.0, 0.0)]},
        },
        [],
    ),
    "memory": Part([], {"memory": [(0.0, 200.0), (1.0, 201.0)]}, []),
}


def test_the_page_tells_figures_machine_and_plots(there):
    keep(page.KEPT, PARTS, page.machine())
    page.write()
    text = page.PAGE.read_text()
    assert "| one run | 0.2 us | 0.1 to 0.3 |" in text
    assert "≥ 100 | yes" in text
    assert "≤ 1.5 | **no**" in text
    assert "a note" in text
    assert "cores" in text
    for name in ("ratios", "lateness", "growth", "memory"):
        assert f"](p/{name}.svg)" in text
        assert (there / "p" / f"{name}.svg").stat().st_size > 1000


@pytest.mark.parametrize(
    ("value", "text"),
    [(None, "–"), (0.0, "0"), (0.000123, "0.00012"), (1.2345, "1.23"), (27144.0, "27 144")],
)
def test_numbers_have_three_digits(value, text):
    assert page.number(value) == text


# Command


def arguments(**given):
    usual = {"only": None, "quick": False, "long": False, "write_docs": False, "json": True}
    return SimpleNamespace(**{**usual, **given})


@pytest.mark.parametrize("given", [{"quick": True, "write_docs": True}, {"only": "bach"}])
def test_bad_input_is_one_line(given):
    from pea_core.params import ParameterError

    with pytest.raises(ParameterError, match=r"^--(quick|only)"):
        bench_cli.COMMANDS["bench"](arguments(**given))


def test_a_regression_is_said_loudly_and_is_no_failure(there, monkeypatch, capsys):
    keep(page.KEPT, {"batch": PARTS["batch"]}, {})
    now = Part([row(100.0)], {}, [])
    monkeypatch.setattr(batch, "measure", lambda plan, tick: now)
    assert bench_cli.COMMANDS["bench"](arguments(only="batch")) == 0
    said = capsys.readouterr()
    assert json.loads(said.out)["batch"]["ratio_vs_opensmc"] == 100.0
    assert "WORSE" in said.err
    assert "worse by 60%" in said.err


def test_a_part_that_fails_is_named_and_the_others_go_on(there, monkeypatch, capsys):
    def fails(plan, tick):
        raise OSError("no room")

    for name in KEYS:
        module = __import__(f"pea_bench.{name}", fromlist=["measure"])
        answer = fails if name == "composed" else lambda plan, tick: Part([], {}, [])
        monkeypatch.setattr(module, "measure", answer)
    assert bench_cli.COMMANDS["bench"](arguments()) == 3
    said = capsys.readouterr()
    assert json.loads(said.out).keys() == KEYS.keys()
    assert "composed could not be measured: OSError: no room" in said.err
