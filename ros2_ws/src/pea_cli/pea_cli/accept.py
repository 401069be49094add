"""``pea accept``: an acceptance report of a stage.

Exit status: 0 done, 2 bad input (one line, nothing moved), 3 a run failed, 130 interrupted.
"""

from __future__ import annotations

import argparse
import datetime
import json
import sys
from pathlib import Path
from typing import Any

from rich.table import Table

from pea_cli import measure
from pea_core.console import bar, err, out
from pea_core.params import ParameterError, nearest


def add(commands: Any) -> None:
    """Add the command to the parser's."""
    accepts = commands.add_parser("accept", help="acceptance report: ASME B5.64, ISO 230-2")
    measure.common(accepts)
    accepts.add_argument("--quick", action="store_true", help="repeat less often, for a first try")
    accepts.add_argument("--only", metavar="A,B", help="only these measurements")
    accepts.add_argument("--yes", action="store_true", help="do not ask before it moves")


def agreed(lines: list[str], yes: bool) -> bool:
    """Announce what will move, and ask; a terminal that closes says no.

    Raises
    ------
    ParameterError
        There is nobody to ask.
    """
    for line in lines:
        err.print(line, highlight=False, markup=False)
    if yes:
        return True
    if not sys.stdin.isatty():
        raise ParameterError("there is no terminal to confirm on: add --yes to move without asking")
    err.print("Move the stage? [y/N] ", end="", markup=False)
    try:
        return input().strip().lower() in ("y", "yes")
    except EOFError:
        err.print()
        return False


def work_in(arguments: argparse.Namespace, kind: str, more: dict[str, Any]) -> Any:
    """The directory of the work, new or resumed."""
    from pea_run.steps_of_work import Steps

    name = Path(arguments.rig or arguments.experiment).stem
    stamp = datetime.datetime.now().strftime("%Y%m%d-%H%M%S")
    there = arguments.out or Path("runs") / f"{kind}-{name}-{stamp}"
    what = {
        "kind": kind,
        "rig": arguments.rig,
        "experiment": arguments.experiment,
        "sets": list(arguments.sets),
        **more,
    }
    return Steps(there, what)


def _accept(arguments: argparse.Namespace) -> int:
    from pea_experiment.checks import refuse_driver
    from pea_measure import acceptance, plans

    mode, options = measure.mode_of(arguments)
    base = plans.Base(arguments.experiment, tuple(arguments.sets), arguments.rig)
    if arguments.at is not None:
        raise ParameterError("--at: an acceptance goes over the whole stroke; omit it")
    only = arguments.only.split(",") if arguments.only else []
    made = acceptance.measurements(base, arguments.quick)
    for name in only:
        if name not in made:
            raise ParameterError(f"--only {name!r}: {nearest(name, made)}")
    made = {name: each for name, each in made.items() if not only or name in only}
    lines = [each.announced() for each in made.values()]
    if arguments.dry_run:
        agreed(lines, True)
        return 0
    for each in made.values() if options else ():
        refuse_driver(each.experiment)
    if not agreed(lines, arguments.yes or not arguments.rig):
        return 0
    steps = work_in(arguments, "accept", {"quick": arguments.quick})

    def work() -> int:
        from pea_report.acceptance import rows, write

        found = {}
        for name, measurement in made.items():
            with bar(err, arguments.json) as shown:
                task = shown.add_task(name, total=measurement.experiment.samples)
                found[name] = steps.measured(
                    name,
                    measurement,
                    mode,
                    lambda k, task=task, shown=shown: shown.update(task, completed=k),
                    **options,
                )
        figures = acceptance.summary(found)
        title = f"Acceptance of {arguments.rig or arguments.experiment}"
        there = steps.there
        if not (there / "acceptance.json").exists():
            write(there, title, figures, found)
        if arguments.json:
            print(json.dumps({"figures": figures, "directory": str(there)}), flush=True)
            return 0
        table = Table("", "value", "unit", "meaning", title=title, title_justify="left")
        for row in rows(figures):
            table.add_row(*row)
        out.print(table)
        out.print(acceptance.SENSOR)
        out.print(f"{there}/acceptance.html, .pdf, .json")
        return 0

    return measure.attempted(work, steps.there)


COMMANDS = {"accept": _accept}
