"""Figures of a run: thinning keeps the extremes, every kind of report is drawn."""

import numpy as np
import pytest

from pea_core.signals import SAMPLE, TRUTH
from pea_experiment import experiments
from pea_experiment.metrics import metrics, truth
from pea_lab import frequency_response
from pea_record import large
from pea_report import figures as report


def test_thinning_keeps_every_peak():
    x = np.zeros(1_000_003)
    x[[17, 500_000, 1_000_001]] = 5.0, -7.0, 3.0
    t, found = report.thin(np.arange(len(x)), x)
    assert len(found) <= report.POINTS + 2
    assert {5.0, -7.0, 3.0} <= set(found)
    assert (np.diff(t) > 0).all()


@pytest.mark.parametrize("of", ["samples", "true"])
def test_a_line_that_is_drawn_in_pieces_is_the_same(of, monkeypatch):
    samples, true = np.zeros(50_003, SAMPLE), np.zeros(50_003, TRUTH)
    x = np.random.default_rng(1).standard_normal(len(samples))
    samples["y"], true["x1"] = x, x
    run = report.Run("", np.arange(len(x)) * 1.0, samples, true, (), {})
    if of == "samples":
        found = run.signal("y")
    else:
        found = lambda part: true["x1"][part]  # noqa: E731
    t, line = report.line(run, found)
    monkeypatch.setattr(large, "PIECE", 1000)
    again = report.line(run, found)
    np.testing.assert_array_equal(np.stack(report.thin(run.t, x)), np.stack((t, line)))
    np.testing.assert_array_equal(np.stack(again), np.stack((t, line)))


def test_few_points_are_left_alone():
    t, x = np.arange(10.0), np.arange(10.0)
    assert report.thin(t, x) == (t, x)


@pytest.mark.parametrize(
    ("name", "sets", "duration", "known"),
    [
        ("fig9_hysteresis_10hz", (), 0.05, False),
        ("sine_series", ("reference.frequencies_hz=[100]", "reference.periods=[2]"), 0.02, True),
        ("fig8_initial_condition", (), 5e-5, True),
    ],
    ids=["without truth", "a series", "one sample"],
)
def test_a_run_is_drawn(name, sets, duration, known, tmp_path):
    experiment = experiments.load(name, sets, duration)
    loop = experiment.loop()
    samples = np.concatenate([loop.run(min(1000, experiment.samples)) for _ in range(2)])
    samples = samples[: experiment.samples]
    true = truth(experiment.plant(), samples, experiment.nominal) if known else None
    figures = metrics(samples, true, experiment.segments, -20.0, 110.0)
    report.draw(tmp_path / "report.png", experiment, figures, samples, true)
    assert report.plt.imread(tmp_path / "report.png").shape[1] > 500


def test_a_response_is_drawn(tmp_path):
    experiment = experiments.load("fig5_frequency_response")
    f = np.geomspace(10.0, 4000.0, 40)
    response = frequency_response.Response(f, frequency_response.model(experiment.nominal, f))
    figures = frequency_response.figures(response, experiment.nominal)
    report.draw_response(tmp_path / "report.png", experiment, figures, response)
    assert report.plt.imread(tmp_path / "report.png").shape[1] > 500
