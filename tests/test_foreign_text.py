"""Names and descriptions of others: shown as text, whatever a terminal, a plot, a page reads in."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from pea_cli import cli
from pea_core.printable import printable
from pea_lab.plot import plt
from pea_record import origin
from pea_report import figures as report

FIG9 = "fig9_hysteresis_10hz"
HOSTILE = {
    "markup": "[/red] [bold] [link=x]",
    "mathtext": r"$\bad$ $x_$ \$",
    "surrogate": "a\udcff\ud800",
    "escape": "\x1b[2J\x1b]0;title\x07",
    "control": "a\rb\x00c\x85\u202e\u2028d",
    "wide": "é中\U0001f600",
    "long": "x" * 5000,
    "html": "</h1><script>alert(1)</script>",
}
ALL_AND_LONG = (" ".join(text for text in HOSTILE.values() if len(text) < 100), HOSTILE["long"])


@pytest.fixture
def pea(tmp_path, monkeypatch, capfd):
    """Run the command line in this process, in an empty directory."""
    monkeypatch.chdir(tmp_path)

    def run(*arguments: str) -> tuple[int, str, str]:
        capfd.readouterr()
        status = cli.main(list(arguments))
        out, err = capfd.readouterr()
        for text in (out, err):
            assert "Traceback" not in text
            assert text.isascii() or text.replace("\n", "").isprintable()
            assert "\x1b" not in text
        lines = err.splitlines(keepends=True)
        told = [line for line in lines if not line.startswith("pea: warning: the run holds")]
        return status, out, "".join(told)

    return run


def test_printable_is_one_line_of_any_text():
    for text in HOSTILE.values():
        shown = printable(text, 100)
        assert shown.isprintable()
        assert len(shown) <= 100
        shown.encode()


@pytest.mark.parametrize("text", HOSTILE.values(), ids=HOSTILE)
def test_a_title_of_any_text_is_drawn(tmp_path, text, recwarn):
    plot = plt.figure(figsize=(4, 3))
    plot.suptitle(printable(text, report.TITLE_MAX))
    plot.gca().plot([0, 1], label=printable(text, report.LABEL_MAX))
    plot.legend()
    report.save(plot, tmp_path / "plot.png")
    assert not recwarn.list


@pytest.mark.parametrize("text", ALL_AND_LONG, ids=["all", "long"])
def test_what_a_run_says_of_itself_is_shown_as_text(pea, monkeypatch, text):
    """Its description, its figure, and the commit that it was made by."""
    monkeypatch.setattr(origin, "commit", lambda: printable(text) if "\ud800" in text else text)
    quoted = json.dumps(text)  # YAML takes what JSON writes
    sets = ("--set", f"experiment.description={quoted}", "--set", f"experiment.figure={quoted}")
    status, _, err = pea("run", FIG9, "--duration", "0.001", "--out", "run", *sets)
    assert (status, err) == (0, ""), err
    for command in (("bag", "info"), ("report",), ("bag", "check")):
        status, _, err = pea(*command, "run")
        assert (status, err) == (0, ""), err
    page = Path("run/analysis.html").read_text(encoding="utf-8")
    assert "<script>alert" not in page
    status, out, _ = pea("bag", "info", "run", "--json")
    assert json.loads(out)["run"]["commit"]


@pytest.mark.parametrize(
    "name", ["../../x", "/tmp/x", "stage/A", ".hidden", "-x", "a\x1b", "a\x00", "x" * 300, "~x"]
)
def test_a_name_that_leads_elsewhere_is_refused(pea, name):
    status, out, err = pea(
        "run", FIG9, "--duration", "0.001", "--set", f"experiment.name={json.dumps(name)}"
    )
    assert (status, out, err.count("\n")) == (2, "", 1), err
    assert "experiment.name" in err
    assert not Path("runs").exists()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("bag", "info", "~nosuch/x"), "there is no user 'nosuch'"),
        (("run", "~nosuch/x.yaml"), "there is no user 'nosuch'"),
        (("run", FIG9, "--out", "~nosuch/x"), "there is no user 'nosuch'"),
        (("run", FIG9, "--out", "a\0b"), "NUL"),
        (("run", "a\0b.yaml"), "NUL"),
        (("run", "x" * 300 + ".yaml"), "too long"),
        (("report", "x" * 300), "too long"),
        (("run", FIG9, "--out", "x" * 5000), "too long"),
        (
            ("run", FIG9, "--set", "reference.type=file", "--set", "reference.path=~nosuch/x"),
            "there is no user",
        ),
        (
            ("run", FIG9, "--set", "reference.type=file", "--set", "reference.path=" + "x/" * 3000),
            "too long",
        ),
        (("run", FIG9, "--duration", "9" * 5000), "--duration"),
        (("run", FIG9, "--seed", "9" * 5000), "--seed"),
        (("run", FIG9, "--set", "plant.seed=" + "9" * 5000), "plant.seed"),
        (("run", FIG9, "--set", "plant.K=" + "9" * 5000), "plant.K"),
        (("dashboard", "--port", "9" * 5000), "--port"),
    ],
)
def test_what_no_file_and_no_number_can_be_is_refused_in_one_line(pea, words, said):
    status, out, err = pea(*words)
    assert (status, out, err.count("\n")) == (2, "", 1), err
    assert said in err
    assert len(err) < 1100
