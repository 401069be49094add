"""`pea accept`, as a user types it, on a simulated stage in batch; its figures by hand."""

import json
import math

import numpy as np
import pytest

from pea_cli.cli import main
from pea_measure import acceptance, motion

QUICK = ("accept", "--quick", "--only", "increments", "--json")


def test_a_report_with_runs_and_it_resumes(tmp_path, monkeypatch, capsys):
    from pea_measure import analysis

    monkeypatch.setattr(analysis, "draw", lambda *_: None)  # takes longer than all else
    monkeypatch.setattr(acceptance, "INCREMENTS_NM", (5.0, 20.0))
    monkeypatch.setenv("PEA_COMPILE", "0")
    there = tmp_path / "a"
    assert main([*QUICK, "--out", str(there)]) == 0
    told = json.loads(capsys.readouterr().out)
    figures = told["figures"]
    assert figures["smallest_increment_nm"] in (5.0, 20.0)
    assert figures["stroke_um"] is None  # not measured
    record = json.loads((there / "acceptance.json").read_text())
    assert record["figures"] == figures
    assert "one sensor cannot check itself" in record["reference_sensor"]
    assert set(record["runs"]) == {"increments"}
    page = (there / "acceptance.html").read_text()
    assert (there / "increments" / "measurement.json").is_file()
    assert list((there / "increments").glob("*.mcap"))
    assert '<a href="increments">' in page
    assert "not measured" in page
    assert (there / "acceptance.pdf").read_bytes().startswith(b"%PDF")
    times = {path: path.stat().st_mtime_ns for path in there.rglob("*")}
    assert main([*QUICK, "--out", str(there)]) == 0
    assert times == {path: path.stat().st_mtime_ns for path in there.rglob("*")}


@pytest.mark.parametrize(
    ("more", "told"),
    [
        (["--at", "3"], "--at"),
        (["--only", "stepps"], "did you mean steps"),
        (["--rig", "nowhere"], "nowhere"),
        (["--mode", "batch", "--clock", "wall"], "--clock wall"),
        (["--set", "plant.voltage_max=none"], "voltage_max"),
    ],
)
def test_refuses_in_one_line(more, told, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["accept", *more]) == 2
    line = capsys.readouterr().err.strip()
    assert told in line
    assert "\n" not in line
    assert not list(tmp_path.iterdir())


def test_repeatability_is_that_of_the_standard():
    """Two positions, worked by hand: s = 1 and 3 up, 2 and 2 down, reversal 4 and 1."""
    positions = np.array([1e-6, 5e-6])
    s = 1e-9 / math.sqrt(2.0)  # two values +- x have the standard deviation x sqrt(2)
    errors = {
        (0, 1): [4e-9 - s, 4e-9 + s],
        (0, -1): [-2 * s, 2 * s],
        (1, 1): [1e-9 - 3 * s, 1e-9 + 3 * s],
        (1, -1): [-2 * s, 2 * s],
    }
    found = acceptance.iso_230_2(positions, errors)
    assert found["repeatability_uni_nm"] == pytest.approx(12.0)
    assert found["repeatability_bi_nm"] == pytest.approx(12.0)  # 2*1 + 2*2 + 4 = 10 < 4*3
    assert found["reversal_nm"] == pytest.approx(4.0)
    assert found["linearity_closed_nm"] == pytest.approx(0.0, abs=1e-6)


def test_width_and_linearity_of_a_loop_by_hand():
    up = np.linspace(0.0, 10.0, 101)
    u = np.concatenate([up, up[::-1]])
    width = 0.3e-6 * np.sin(math.pi * up / 10.0)
    y = np.concatenate([1e-7 * up, 1e-7 * up[::-1] + width[::-1]])
    found, stroke = motion.loop_width(u, y, 101)
    assert found == pytest.approx(0.3e-6, rel=1e-3)
    assert stroke == pytest.approx(np.ptp(y))
    slope, off = motion.linearity(up, 2e-7 * up)
    assert (slope, off) == (pytest.approx(2e-7), pytest.approx(0.0, abs=1e-9))


@pytest.mark.parametrize("command", ["accept", "commission"])
def test_one_axis_of_a_rig_of_two_is_chosen_by_its_name(command, capsys):
    words = ["--rig", "e727_xy_emulated", "--dry-run"]
    assert main([command, "sine_series@y", *words]) == 0
    assert "noise: " in capsys.readouterr().err
    assert main([command, "sine_series", *words]) == 2
    said = capsys.readouterr().err
    assert "has the axes x, y, and this takes one: write sine_series@x" in said
    assert said.count("\n") == 1
