"""``pea check``: what theory says of the loop of an experiment."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from typing import Any

from rich.table import Table

from pea_cli.options import path_of, sets
from pea_core.console import out
from pea_core.params import ParameterError
from pea_experiment import experiments
from pea_experiment.experiment import MultiAxis


def add(commands: Any) -> None:
    """Add the command to the parser's."""
    checks = commands.add_parser(
        "check", help="poles, margins and noise of an experiment's loop, from theory"
    )
    checks.add_argument("experiment", metavar="EXPERIMENT", help="name, or path of a YAML file")
    checks.add_argument("--json", action="store_true", help="as JSON")
    checks.add_argument(
        "--plot", metavar="FILE", type=path_of, help="Bode, Nyquist, sensitivity: .pdf, .svg, .png"
    )
    checks.add_argument("--rig", metavar="NAME", help="rig to drive, from config/rigs/")
    sets(checks)


def _check(arguments: argparse.Namespace) -> int:
    from pea_lab.check import check, rows, stepped
    from pea_lab.settling import unslewed
    from pea_observer.matching import matching

    there = arguments.plot
    if there is not None:
        from pea_lab.bode import refuse

        refuse(there)
    experiment = experiments.load_axes(arguments.experiment, arguments.sets, rig=arguments.rig)
    if isinstance(experiment, MultiAxis):
        return _check_axes(arguments, experiment)
    figures = stepped(experiment, check(experiment))
    if there is not None:
        from pea_lab.bode import draw

        draw(there, experiment)
    if arguments.json:
        print(json.dumps(figures), flush=True)
        return 0
    table = Table("", "value", "unit", title=experiment.name, title_justify="left")
    for row in rows(figures):
        table.add_row(*row)
    out.print(table)
    theory = str(matching(experiment.nominal, experiment.T_s))
    for line in (theory, figures["note"], unslewed(experiment)):
        if line:
            out.print(line)
    if there is not None:
        out.print(f"plot  {there}", highlight=False, markup=False)
    return 0


def _check_axes(arguments: argparse.Namespace, experiment: MultiAxis) -> int:
    """The coupled loop of several axes."""
    from pea_lab.coupled import check_axes, rows

    if arguments.plot is not None:
        raise ParameterError(
            f"--plot {arguments.plot}: draws the loop of one axis; take "
            f"{arguments.experiment}@{experiment.axes[0]}"
        )
    figures = check_axes(experiment)
    if arguments.json:
        print(json.dumps(figures), flush=True)
        return 0
    table = Table("", *experiment.axes, title=experiment.name, title_justify="left")
    for row in rows(figures):
        table.add_row(*row)
    out.print(table)
    if figures["note"]:
        out.print(figures["note"])
    return 0


COMMANDS: dict[str, Callable[[argparse.Namespace], int]] = {"check": _check}
