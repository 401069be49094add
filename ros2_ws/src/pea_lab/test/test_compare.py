"""Comparing: every combination, each as `pea run` would have it, and what is told of it."""

import csv
import json

import pytest

from pea_core.params import ParameterError
from pea_experiment import experiments
from pea_experiment.metrics import metrics, truth
from pea_lab import compare
from pea_lab.plot import plt

QUICK = ("reference.frequencies_hz=[100, 200]", "reference.periods=[2]")
BOTH = {"controllers": ["pid", "recommended"], "observers": [], "plants": ["none", "preisach"]}


def combinations(*sets, **names):
    return compare.combinations("sine_series", (*QUICK, *sets), **{**BOTH, **names}, duration=0.03)


@pytest.fixture(scope="module")
def rows():
    return [compare.measured(each) for each in combinations()]


def test_every_controller_meets_every_observer_and_plant():
    found = combinations(observers=["kalman", "luenberger"])
    names = {(c.controller, c.observer, c.plant) for c in found}
    assert len(found) == len(names) == 8
    assert ("pid", "luenberger", "preisach") in names


def test_what_is_not_named_is_the_experiments_own():
    (only,) = combinations(controllers=[], plants=[])
    assert (only.controller, only.observer) == ("recommended", "extended_state")
    assert only.experiment.nodes == combinations(plants=[])[1].experiment.nodes


def test_a_wrong_name_stops_all_before_anything_runs():
    with pytest.raises(ParameterError, match="unknown observer 'kalmann'"):
        combinations(observers=["kalman", "kalmann"])


def test_a_row_is_what_a_run_of_its_own_gives(rows):
    sets = (*QUICK, "plant.hysteresis.type=preisach", "controller.preset=pid")
    experiment = experiments.load("sine_series", sets, 0.03)
    samples = experiment.loop().run(600)
    true = truth(experiment.plant(), samples, experiment.nominal)
    expected = metrics(samples, true, experiment.segments, -20.0, 110.0)
    row = next(r for r in rows if (r["controller"], r["plant"]) == ("pid", "preisach"))
    # the pid of a comparison is the preset alone, without what the experiment says of its own law
    assert row["trace_sha256"] == expected["trace_sha256"]
    assert row["segments"] == expected["segments"]


def test_the_curve_holds_the_whole_run(rows):
    for row in rows:
        power = sum(x * x for x in row["curve_nm"]) / len(row["curve_nm"])
        assert len(row["curve_nm"]) == compare.WINDOWS
        assert max(row["curve_nm"]) ** 2 > power > 0.0


def test_an_unstable_combination_is_told_and_not_run():
    (only,) = combinations("controller.I=60", controllers=["recommended"], plants=["none"])
    row = compare.measured(only)
    assert row["failure"].startswith("unstable on the nominal plant: ")
    assert "rms_error_nm" not in row
    assert only.refusal == row["failure"]


def test_force_runs_it_all_the_same():
    (only,) = combinations(
        "controller.I=60", controllers=["recommended"], plants=["none"], force=True
    )
    assert compare.measured(only)["rms_error_nm"] > 100.0


def test_all_cores_give_what_one_gives(rows):
    told = []
    both = compare.run(combinations()[:2], told.append, processes=2)
    assert [row["trace_sha256"] for row in both] == [row["trace_sha256"] for row in rows[:2]]
    assert told[-1] == 2 * 600


def test_files_tell_every_row_and_frequency(rows, tmp_path):
    failed = {**dict.fromkeys(("controller", "observer", "plant"), "x"), "failure": "no"}
    compare.write(tmp_path, "sine_series", [*rows, failed], 0.03)
    with (tmp_path / "compare.csv").open(newline="") as file:
        lines = list(csv.DictReader(file))
    assert len(lines) == 4 * 3 + 1
    assert [line["frequency_hz"] for line in lines[:3]] == ["", "100.0", "200.0"]
    assert float(lines[1]["rms_error_nm"]) == rows[0]["segments"][0]["rms_error_nm"]
    assert lines[-1]["failure"] == "no"
    told = json.loads((tmp_path / "compare.json").read_text())
    assert len(told["rows"]) == 5
    assert "curve_nm" not in told["rows"][0]
    assert plt.imread(tmp_path / "compare.png").shape[1] > 500
    assert "tracking error" in (tmp_path / "compare.svg").read_text(encoding="utf-8")


def test_the_table_shows_what_says_something(rows):
    title, group = next(iter(compare.groups(rows).items()))
    assert title == "plant none, observer extended_state"
    heads, cells = compare.table(group)
    assert heads[:3] == ["controller", "100 Hz", "200 Hz"]
    assert "overshoot %" not in heads
    assert [row[0] for row in cells] == ["pid", "recommended"]
    assert float(cells[0][1]) == pytest.approx(group[0]["segments"][0]["rms_error_nm"], rel=6e-3)
