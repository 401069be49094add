"""`pea commission`, as a user types it, on a simulated stage in batch."""

import io
import json
import sys
from pathlib import Path

import pytest

from pea_cli.cli import main

SHORT = ("commission", "--set", "plant.preset=resonant_one_mode", "--set", "T_s=4e-4", "--yes")
"""A rate at which every step takes about a second."""


@pytest.fixture(scope="module")
def work(tmp_path_factory):
    """Commission a resonant stage to the end, interrupted after the first measurement."""
    there = tmp_path_factory.mktemp("work") / "c"
    argv = [*SHORT, "--out", str(there)]
    with pytest.MonkeyPatch.context() as patch:
        from pea_identify import slow
        from pea_measure import analysis, commissioning, loop_response
        from pea_report import figures
        from pea_run import steps_of_work

        # pictures take longer than all else
        patch.setattr(figures, "draw", lambda *_, **__: None)
        patch.setattr(analysis, "draw", lambda *_: None)
        patch.setattr(loop_response, "DRAWS", 40)
        patch.setattr(commissioning, "SLOW", 0.5)
        patch.setattr(slow, "POINTS", 1000)

        carry_out = steps_of_work.carry_out

        def interrupted(measurement, mode, path, *rest, **options):
            if measurement.kind == "hysteresis":
                path.mkdir()  # what a run leaves that did not end
                raise KeyboardInterrupt
            return carry_out(measurement, mode, path, *rest, **options)

        patch.setattr(steps_of_work, "carry_out", interrupted)
        assert main(argv) == 130
        patch.setattr(steps_of_work, "carry_out", carry_out)
        before = {path: path.read_bytes() for path in there.rglob("*") if path.is_file()}
        assert main([*argv, "--step", "measure"]) == 0
        assert not (there / "identify.json").exists()
        assert main(argv) == 0
    return there, before


def test_runs_to_its_end(work):
    there, _ = work
    model, gains = (json.loads((there / f"{n}.json").read_text()) for n in ("identify", "propose"))
    found = model["parameters"]
    assert found["omega_n_1_rad_s"]["value"] == pytest.approx(4643.27, rel=0.002)
    assert found["zeta_1"]["value"] == pytest.approx(0.01, rel=0.1)
    # displacement over the largest voltage, without the creep
    assert found["K_um_per_V"]["value"] == pytest.approx(0.1367, rel=0.01)
    assert found["K_small_um_per_V"]["value"] == pytest.approx(0.142 * 0.5132, rel=0.01)
    # about half of K: the slope of the default hysteresis for a small signal
    assert 0.45 < found["K_small_um_per_V"]["value"] / found["K_um_per_V"]["value"] < 0.6
    assert gains["by"] == "pea tune --from-model"
    assert "controller.effort" in gains["gains"]
    assert any(
        "as for small signals" in name for name in json.loads((there / "check.json").read_text())
    )
    assert "Measured with these gains" in (there / "commission.html").read_text()


def test_resumes_and_overwrites_nothing(work):
    there, before = work
    assert before
    for path, data in before.items():
        assert path.read_bytes() == data
    assert json.loads((there / "hysteresis.json").read_text())["run"].endswith("hysteresis-2")


def test_a_finished_one_is_only_reported(work, capsys):
    there, _ = work
    times = {path: path.stat().st_mtime_ns for path in there.rglob("*")}
    assert main([*SHORT, "--json", "--out", str(there)]) == 0
    assert json.loads(capsys.readouterr().out)["directory"] == str(there)
    assert times == {path: path.stat().st_mtime_ns for path in there.rglob("*")}


def test_a_terminal_that_closes_says_no_and_the_work_can_go_on(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.stdin", io.StringIO(""))
    monkeypatch.setattr(sys.stdin, "isatty", lambda: True)
    assert main(["commission", "--rig", "simulated_200hz"]) == 130
    (there,) = Path("runs").iterdir()
    assert f"to go on: the same command with --out {there}" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("more", "told"),
    [
        (["--step", "tune"], "--step 'tune'"),
        (["--step", "propose"], "--step propose: give --out"),
        (["--step", "propose", "--out", "new"], "step identify is not done yet"),
        (["--trials", "0"], "--trials"),
        (["--at", "40"], "outside what the stage allows"),
        (["--amplitude", "200"], "amplitude_V"),
        (["--set", "reference.type=sine"], "reference.type"),
    ],
)
def test_refuses_in_one_line(more, told, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main([*SHORT, *more]) == 2
    line = capsys.readouterr().err.strip()
    assert told in line.splitlines()[-1]
    assert "Traceback" not in line
    assert "\n" not in line


def test_the_law_of_the_user_stands_back_in_open_loop():
    from pea_measure.plans import Base, hysteresis

    sets = ("controller.preset=pid", "controller.K_i=100.0", "controller.feedforward=true")
    made = hysteresis(Base("sine_series", sets), None, None, 2.0, 1)
    law = made.experiment.nodes["controller"]
    assert law.values["type"] == "open_loop"
    assert law.params.feedforward is False
