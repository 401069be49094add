"""Tables in a terminal: 80 columns, what matters first."""

import io

from rich.console import Console

from pea_cli.cli import main
from pea_cli.run import table
from pea_core import console

FIGURES = {
    "experiment": "a_name_of_an_experiment_that_is_rather_long_as_names_go_in_some_labs",
    "samples": 10000,
    "samples_per_s": 1234567.8,
    "rms_error_nm": 13.85,
    "max_error_nm": 35.4,
    "scored": "the last 2 periods of 10 Hz, 0.3 s to 0.5 s, in words that go on and on and on",
    "trace_sha256": "4705cd3b8c51c80b988201879d3da8475bc8362c7e1c2f45a7518409d76f2b2e",
}


def drawn(what):
    text = io.StringIO()
    Console(file=text, width=80, force_terminal=False).print(what)
    return text.getvalue().splitlines()


def test_the_table_of_a_run_begins_with_the_error_and_fits():
    lines = drawn(table(FIGURES))
    assert max(map(len, lines)) <= 80
    rows = [line.split()[1] for line in lines if line.startswith("│")]
    assert rows[:2] == ["rms_error_nm", "max_error_nm"]
    shown = "".join(line.split("│")[2].strip() for line in lines if line.startswith("│"))
    assert FIGURES["trace_sha256"] in shown  # nothing is cut off


def test_the_list_fits_into_80_columns(capsys, monkeypatch):
    monkeypatch.setattr(console.out, "width", 80)
    assert main(["list"]) == 0
    assert max(map(len, capsys.readouterr().out.splitlines())) <= 80
