"""The plot of a report: every extreme is in it, and nothing is fetched."""

import math
import re

import numpy as np
import pytest

from pea_core.signals import SAMPLE
from pea_lab.tune import Goal, Trial
from pea_report import interactive, overview
from pea_report.figures import LINE, Run

N = 200_000


@pytest.fixture
def run():
    samples = np.zeros(N, SAMPLE)
    samples["y"] = 1e-6 * np.sin(np.arange(N) * 1e-3)
    samples["y"][123_456] = 9e-6  # one sample
    return Run("a", np.arange(N) * 50e-6, samples, None, (), {})


def test_a_single_sample_that_sticks_out_is_drawn(run):
    plot = interactive.figure([run])
    y = next(trace for trace in plot.data if trace.name == "y")
    assert len(y.y) <= LINE
    assert max(y.y) == pytest.approx(9.0)
    assert 123_456 * 50e-6 in np.asarray(y.x)


def test_the_legend_stands_outside_and_runs_are_told_apart(run):
    plot = interactive.figure([run, run])
    assert plot.layout.legend.y < 0
    assert len({trace.line.color for trace in plot.data if trace.name.endswith(": y")}) == 2


def test_pages_of_loops_and_candidates_hold_all_of_them_and_fetch_nothing(tmp_path):
    curve = np.linspace(1.0, 2.0, 50)
    loop = {"controller": "pid", "observer": "kalman", "curve_nm": curve, "rms_error_nm": 1.5}
    rows = [{**loop, "plant": "one"}, {**loop, "plant": "<two>"}]
    rows.append({"controller": "smc", "observer": "kalman", "plant": "one", "failure": "unstable"})
    overview.compared(tmp_path / "compare.html", "<name>", rows, 0.1)
    trials = [
        Trial({"controller.P": p}, error, 0.1, 9.0, 1.5, 1.5, 1.6, good)
        for p, error, good in ((0.1, 3.0, True), (0.2, 2.0, False), (0.3, math.inf, False))
    ]
    overview.tuned(tmp_path / "tune.html", "name", Goal(1.3, {"given": ()}, {}), trials)
    for name, words in (
        ("compare", ("&lt;name&gt;", "1.5 nm where", "3 loops")),
        ("tune", ("controller.P 0.2", "3 candidates over 1 plants")),
    ):
        text = re.sub(r'base64,[^"]*', "", (tmp_path / f"{name}.html").read_text())
        assert all(word in text for word in words)
        assert "<name>" not in text
        assert not re.search(r"https?:", text)


def test_nothing_is_fetched(run):
    text = interactive.part_of_page([run])
    assert not re.search(r"https?:", re.sub(r'base64,[^"]*', "", text))
