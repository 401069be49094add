"""``pea doctor``: sample rates that this machine sustains in wall time."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from typing import Any

from rich.table import Table
from rich.text import Text

from pea_cli.options import cpu, number
from pea_core.console import out
from pea_experiment.metrics import unit


def add(commands: Any) -> None:
    """Add the command to the parser's."""
    doctors = commands.add_parser(
        "doctor", help="sample rates that this machine sustains in wall time"
    )
    doctors.add_argument("--cpu", metavar="N", help="core to measure on")
    doctors.add_argument("--seconds", metavar="S", default="2", help="how long (default: 2)")
    doctors.add_argument("--json", action="store_true", help="as JSON")


def _doctor(arguments: argparse.Namespace) -> int:
    from pea_run import doctor

    core = cpu(arguments)
    seconds = number("--seconds", arguments.seconds, 0.1, 3600.0, "s")
    findings = doctor.findings(core)
    deadlines = doctor.measure(seconds, core)
    if arguments.json:
        rows = [finding._asdict() for finding in findings]
        figures = {**deadlines.figures(), **deadlines.conditions}
        print(json.dumps({"findings": rows, "empty_loop": figures}), flush=True)
        return 0
    table = Table("", "found", "to change", title="This machine", title_justify="left")
    for finding in findings:
        style = "green" if finding.fine else "yellow"
        table.add_row(finding.what, Text(finding.found, style), finding.advice or "fine")
    out.print(table)
    loop = Table("empty loop", "value", "unit", title="Measured at 20 kHz", title_justify="left")
    for name, value in deadlines.figures().items():
        told = f"{value:.6g}" if isinstance(value, float) else str(value)
        loop.add_row(name, told, unit(name))
    out.print(loop)
    out.print(doctor.verdict(deadlines))
    return 0


COMMANDS: dict[str, Callable[[argparse.Namespace], int]] = {"doctor": _doctor}
