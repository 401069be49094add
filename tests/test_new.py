"""`pea new`: each skeleton passes its own test, installed, and runs; `pea completion`."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys

import pytest

from pea_cli.cli import main
from pea_cli.new import KINDS


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Folder with one package of each kind, and the environment that they are installed in."""
    there, site = tmp_path_factory.mktemp("made"), tmp_path_factory.mktemp("site")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(there)
        assert not [kind for kind in KINDS if main(["new", kind, f"my_{kind}"])]
    install = [sys.executable, "-m", "pip", "install", "--quiet", "--no-index", "--no-deps"]
    install += ["--no-build-isolation", "--disable-pip-version-check", "--target", str(site)]
    subprocess.run([*install, *map(str, there.iterdir())], cwd=there, check=True)
    return there, {**os.environ, "PYTHONPATH": f"{site}:{os.environ['PYTHONPATH']}"}


def ran(made, *words):
    there, env = made
    done = subprocess.run(words, cwd=there, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_the_tests_of_each_pass_and_none_is_left_out(made):
    words = ("-m", "pytest", "-q", "--import-mode=prepend", "-p", "no:cacheprovider")
    said = ran(made, sys.executable, *words, ".")
    assert "skipped" not in said
    assert "passed" in said


@pytest.mark.parametrize("kind", ["law", "observer", "reference", "driver"])
def test_a_model_may_be_imported_first(made, kind):
    """Through it the package of its kind is imported, which looks for it."""
    asks = (
        f"import my_{kind}; from pea_core import registry; assert not any(registry.BROKEN.values())"
    )
    asks += "; from pea_experiment.experiment import SCHEMAS; import sys"
    asks += f"; assert sys.modules['my_{kind}'] is my_{kind}"
    ran(made, sys.executable, "-c", asks)


def test_each_is_listed_and_they_run_together(made):
    pea = (sys.executable, "-m", "pea_cli.cli")
    found = json.loads(ran(made, *pea, "list", "--json"))
    for kind in KINDS:
        assert f"my_{kind}" in found[f"{'controller' if kind == 'law' else kind}s"]
    sets = ("controller.type=my_law", "observer.type=my_observer", "reference.type=my_reference")
    words = [word for each in sets for word in ("--set", each)]
    metrics = json.loads(
        ran(made, *pea, "run", "my_experiment", *words, "--duration", "0.1", "--json")
    )
    assert metrics["samples"] == 2000
    assert metrics["rms_error_nm"] < 100


def test_a_name_that_two_have_is_refused_naming_both(made, tmp_path):
    """An experiment of ours that a lab's package has as well, and a law of ours."""
    there, env = made
    site, about = tmp_path / "site", tmp_path / "site" / "lab-1.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: lab\nVersion: 1\n")
    points = "[pea.config]\nlab = lab\n[pea.laws]\npid = my_law\n"
    (about / "entry_points.txt").write_text(points)
    experiment = there / "my_experiment/my_experiment/experiments/my_experiment.yaml"
    (site / "lab/experiments").mkdir(parents=True)
    (site / "lab/controllers").mkdir()
    (site / "lab/controllers/precise.yaml").write_text("# Of the lab.\n")
    (site / "lab/__init__.py").touch()
    shutil.copy(experiment, site / "lab/experiments/sine_series.yaml")
    shutil.copy(experiment, site / "lab/experiments/mine.yaml")
    (site / "lab/experiments/broken.yaml").write_text("x: [")
    section = "/pea/plant:\n  ros__parameters: {driver.type: nosuch}\n"
    (site / "lab/experiments/nosuch.yaml").write_text(section)
    (site / "lab/rigs").mkdir()
    (site / "lab/rigs/nosuch.yaml").write_text(section)
    env = {**env, "PYTHONPATH": f"{site}:{env['PYTHONPATH']}"}

    def says(*words):
        pea = (sys.executable, "-m", "pea_cli.cli")
        return subprocess.run([*pea, *words], cwd=tmp_path, env=env, capture_output=True, text=True)

    short = ("--duration", "0.01", "--no-report", "--out")
    twice = says("run", "sine_series", *short, "a")
    assert twice.returncode == 2
    assert "experiment 'sine_series': may be " in twice.stderr
    assert str(site / "lab/experiments/sine_series.yaml") in twice.stderr
    law = says("run", "mine", "--set", "controller.type=pid", *short, "b")
    assert law.returncode == 2
    assert "pea_controller.model.pid and my_law both have this name" in law.stderr
    assert says("run", "mine", *short, "c").returncode == 0
    listed = json.loads(says("list", "--json").stdout)
    assert "both have this name" in listed["controllers"]["pid"]
    assert listed["experiments"]["sine_series"].startswith("cannot be used: experiment")
    assert listed["controller presets"]["precise"].startswith("cannot be used: controller")
    assert "broken.yaml: x: must hold" in listed["experiments"]["broken"]
    for kind in ("experiments", "rigs"):
        assert "driver.type = 'nosuch'" in listed[kind]["nosuch"]
    assert "cannot be used" not in listed["experiments"]["mine"]


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("new", "lawn", "mine"), "did you mean law"),
        (("new", "law", "My-Law"), "must be lower case"),
        (("new", "law", "class"), "must be lower case"),
        (("new", "law", "pidsmc"), "law 'pidsmc' exists already"),
        (("new", "rig", "e727_emulated"), "rig 'e727_emulated' exists already"),
        (("new", "experiment", "sine_series"), "experiment 'sine_series' exists already"),
        (("new", "driver", "numpy"), "Python module 'numpy' exists already"),
        (("completion", "csh"), "unknown shell 'csh'"),
    ],
)
def test_what_is_wrong_is_one_line(words, says, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(words) == 2
    said = capsys.readouterr().err
    assert says in " ".join(said.split())
    assert not list(tmp_path.iterdir())


def test_nothing_is_written_over(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine").mkdir()
    assert main(["new", "rig", "mine"]) == 2
    assert "exists already" in capsys.readouterr().err


def test_bash_completes_commands(capsys):
    assert main(["completion", "bash"]) == 0
    script = capsys.readouterr().out
    asks = 'COMP_WORDS=(pea rep); COMP_CWORD=1; _shtab_pea; echo "${COMPREPLY[@]}"'
    done = subprocess.run(["bash", "-c", f"{script}\n{asks}"], capture_output=True, text=True)
    assert set(done.stdout.split()) == {"replay", "report"}


@pytest.mark.parametrize(("shell", "checks"), [("zsh", "-n"), ("fish", "--no-execute")])
def test_other_shells_can_read_theirs(shell, checks, capsys, tmp_path):
    assert main(["completion", shell]) == 0
    script = capsys.readouterr().out
    assert "replay" in script
    if shutil.which(shell):
        (tmp_path / "script").write_text(script)
        subprocess.run([shell, checks, str(tmp_path / "script")], check=True)
