"""The plot of a report: every extreme is in it, and nothing is fetched."""

import re

import numpy as np
import pytest

from pea_core.signals import SAMPLE
from pea_report import interactive
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


def test_nothing_is_fetched(run):
    text = interactive.part_of_page([run])
    assert not re.search(r"https?:", re.sub(r'base64,[^"]*', "", text))
