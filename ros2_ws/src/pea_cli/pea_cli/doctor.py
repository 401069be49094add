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
    doctors.add_argument(
        "--rig", metavar="NAME", help="measure the exchange with its device, the output held"
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
    line = _line(arguments.rig, seconds, core) if arguments.rig else None
    if arguments.json:
        rows = [finding._asdict() for finding in findings]
        figures = {**deadlines.figures(), **deadlines.conditions}
        told: dict[str, Any] = {"findings": rows, "empty_loop": figures}
        if line is not None:
            told["exchange"] = {**line.figures(), "holds": doctor.holds(line)}
        print(json.dumps(told), flush=True)
        return 0
    table = Table("", "found", "to change", title="This machine", title_justify="left")
    for finding in findings:
        style = "green" if finding.fine else "yellow"
        table.add_row(finding.what, Text(finding.found, style), finding.advice or "fine")
    out.print(table)
    _show("empty loop", "Measured at 20 kHz", deadlines.figures())
    out.print(doctor.verdict(deadlines))
    if line is not None:
        _show("exchange", f"Measured on {line.identity}, the output held", line.figures())
        out.print(doctor.holds(line))
    return 0


def _show(what: str, title: str, figures: dict[str, Any]) -> None:
    table = Table(what, "value", "unit", title=title, title_justify="left")
    for name, value in figures.items():
        shown = f"{value:.6g}" if isinstance(value, float) else str(value)
        table.add_row(name, shown, unit(name))
    out.print(table)


def _line(name: str, seconds: float, core: int | None) -> Any:
    """What the exchange with a rig's device shows."""
    from pea_core.params import ParameterError
    from pea_experiment import experiments
    from pea_plant.drivers.driver import DriverError
    from pea_run import doctor

    rigged = experiments.load_axes("fig4_pid_step", rig=name)
    each = tuple(one.nodes["plant"].params for one in rigged.each)
    try:
        return doctor.line(each[0] if len(each) == 1 else each, rigged.T_s, seconds, core)
    except DriverError as error:
        raise ParameterError(f"rig {name!r}: {error}") from None


COMMANDS: dict[str, Callable[[argparse.Namespace], int]] = {"doctor": _doctor}
