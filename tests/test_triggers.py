"""Triggered recordings in every mode: the same windows, the same bits."""

import numpy as np
import pytest

from pea_cli import cli
from pea_core.config import BATCH, COMPOSED, DISTRIBUTED
from pea_record.read import load
from pea_record.trigger import windows

SHORT = ("fig9_hysteresis_10hz", "--duration", "0.3")
TRIGGER = (
    "--trigger-source", "y", "--trigger-level", "7.5", "--trigger-edge", "rising",
    "--trigger-pre", "0.002", "--trigger-post", "0.004",
)  # fmt: skip


@pytest.mark.parametrize("mode", [BATCH, COMPOSED, DISTRIBUTED])
def test_every_mode_keeps_the_same_windows(recorded, mode):
    run = recorded(mode, *SHORT, *TRIGGER)
    whole = load(recorded(BATCH, *SHORT).directory)
    kept = load(run.directory)
    found = windows(kept.metadata)
    assert len(found) == run.metrics["windows"] == 3
    y = whole.samples["y"] * 1e6
    rises = np.flatnonzero((y[:-1] < 7.5) & (y[1:] >= 7.5)) + 1
    inside = np.zeros(len(y), bool)
    for k in rises:
        inside[max(k - 40, 0) : k + 81] = True
    assert (kept.stamps // kept.T_ns).tolist() == np.flatnonzero(inside).tolist()
    assert (kept.samples == whole.samples[inside]).all()
    assert cli.main(["bag", "check", str(run.directory)]) == 0
    for file in run.directory.glob("*.mcap"):
        assert cli.main(["bag", "check", str(file)]) == 0


@pytest.mark.parametrize("mode", [BATCH, DISTRIBUTED])
def test_the_sample_signal_is_there_at_every_sample_of_a_window(recorded, mode):
    run = recorded(mode, *SHORT, *TRIGGER, "--set", "plant.stage.specimen=exp(-x)")
    kept = load(run.directory)
    assert len(kept.samples) == 363
    assert np.isfinite(kept.signal).all()


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (("--trigger-source", "hight"), "--trigger-source = 'hight': "),
        (("--trigger-source", "y"), "needs a level; add --trigger-level in um"),
        (
            ("--trigger-source", "y", "--trigger-level", "much"),
            "--trigger-level much: give a number",
        ),
        (("--trigger-source", "trip", "--no-record"), "--no-record"),
        (("--trigger-source", "line"), "the reference is no scan"),
    ],
)
def test_what_is_no_trigger_is_refused_in_one_line(words, text, capsys):
    assert cli.main(["run", SHORT[0], *words]) == 2
    said = capsys.readouterr().err
    assert text in said
    assert said.count("\n") == 1
