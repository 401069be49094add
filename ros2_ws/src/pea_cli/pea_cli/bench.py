"""How fast everything is: ``pea bench``.

Exit status: 0 done, whatever the figures are; 3 a part could not be measured.
"""

from __future__ import annotations

import argparse
import json
import subprocess
from typing import Any

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table
from rich.text import Text

from pea_core.console import err, out
from pea_core.params import ParameterError, nearest


def add(commands: Any) -> None:
    """Add the command to the parser's."""
    benches = commands.add_parser(
        "bench", help="measure the speed, and that of what it is compared with"
    )
    benches.add_argument(
        "--only",
        metavar="PART",
        help="batch, composed, distributed, recorder, startup, hardware, axes",
    )
    benches.add_argument("--quick", action="store_true", help="a short run: the figures are rough")
    benches.add_argument("--long", action="store_true", help="also watch memory for ten minutes")
    benches.add_argument("--write-docs", action="store_true", help="keep the figures in docs/")
    benches.add_argument("--json", action="store_true", help="print the figures, and only them")


def _bench(arguments: argparse.Namespace) -> int:
    import importlib

    from pea_bench import page, plan
    from pea_bench.rows import KEYS, figures, keep, kept, worse

    if arguments.quick and (arguments.long or arguments.write_docs):
        raise ParameterError("--quick: its figures are too rough to keep; omit it")
    if arguments.only is not None and arguments.only not in KEYS:
        advice = nearest(arguments.only, KEYS)
        raise ParameterError(f"--only: unknown part {arguments.only!r}: {advice}")
    names = [arguments.only] if arguments.only else list(KEYS)
    names += ["memory"] if arguments.long else []
    modules = {name: importlib.import_module(f"pea_bench.{name}") for name in names}
    sizes = plan.QUICK if arguments.quick else plan.USUAL
    before = {} if arguments.quick else kept(page.KEPT)  # other sizes give other ratios
    parts, failed = {}, {}
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    with Progress(*columns, TimeElapsedColumn(), console=err, transient=True) as progress:
        tasks = {n: progress.add_task(n, total=modules[n].steps(sizes), start=False) for n in names}
        for name, task in tasks.items():
            progress.start_task(task)
            try:
                parts[name] = modules[name].measure(sizes, lambda t=task: progress.advance(t))
            except (Exception, subprocess.SubprocessError) as error:  # the other parts go on
                failed[name] = f"{type(error).__name__}: {error}"
                continue
            if arguments.write_docs:
                keep(page.KEPT, {name: parts[name]}, page.machine())
    if arguments.write_docs:
        page.write()
    told = [line for n, p in parts.items() if n in before for line in worse(p.rows, before[n].rows)]
    if arguments.json:
        rows = [row for part in parts.values() for row in part.rows]
        print(json.dumps(figures(rows, [n for n in names if n in KEYS])), flush=True)
    else:
        for part in parts.values():
            out.print(_table(part.rows))
        for line in (note for part in parts.values() for note in part.notes):
            out.print(line, highlight=False, markup=False)
    for line in told:
        err.print(f"pea: WORSE than the kept figures: {line}", style="bold red", highlight=False)
    for name, words in failed.items():
        err.print(f"pea: {name} could not be measured: {words}", highlight=False, markup=False)
    return 3 if failed else 0


def _table(rows: list[Any]) -> Table:
    from pea_bench.page import number, spread

    part = rows[0].name.partition(".")[0]
    table = Table("", "", "rounds from, to", "asked", title=part, title_justify="left")
    for row in rows:
        style = {True: "green", False: "yellow", None: ""}[row.fine]
        value = Text(f"{number(row.value)} {row.unit}".rstrip(), style, justify="right")
        table.add_row(row.what, value, spread(row), row.demand)
    return table


COMMANDS = {"bench": _bench}
