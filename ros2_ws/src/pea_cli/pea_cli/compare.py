"""``pea compare``: controllers, observers and plants side by side."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.table import Table

from pea_cli.options import duration, path_of, sets
from pea_core.console import bar, err, out
from pea_core.params import ParameterError

TEXT_MIN, GAP = 20, 2
"""Characters that text takes beside numbers, and that stand between two columns."""


def add(commands: Any) -> None:
    """Add the command to the parser's."""
    compares = commands.add_parser("compare", help="controllers, observers, plants side by side")
    compares.add_argument(
        "experiment",
        metavar="EXPERIMENT",
        nargs="?",
        default="sine_series",
        help="name, or path of a YAML file (default: sine_series)",
    )
    for names in ("controllers", "observers", "plants"):
        compares.add_argument(
            f"--{names}", metavar="A,B,C", help="presets or types, separated by commas"
        )
    compares.add_argument("--duration", metavar="S", help="seconds of loop time of each run")
    compares.add_argument("--out", metavar="DIR", type=path_of, help="new directory")
    compares.add_argument("--json", action="store_true", help="print the rows, and only them")
    compares.add_argument(
        "--force", action="store_true", help="also run loops that would be refused"
    )
    sets(compares)


def _names(option: str, text: str | None) -> list[str]:
    if text is None:
        return []
    names = [name.strip() for name in text.split(",")]
    if not all(names):
        raise ParameterError(f"{option} {text!r}: give names separated by commas")
    return names


def _compare(arguments: argparse.Namespace) -> int:
    from pea_lab import compare
    from pea_run.run import directory

    length = duration(arguments)
    given = {n: _names(f"--{n}", getattr(arguments, n)) for n in ("observers", "plants")}
    controllers = _names("--controllers", arguments.controllers) or list(compare.CONTROLLERS)
    if arguments.experiment == "sine_series":
        given["observers"] = given["observers"] or list(compare.OBSERVERS)
        given["plants"] = given["plants"] or list(compare.PLANTS)
    what = compare.combinations(
        arguments.experiment,
        arguments.sets,
        controllers,
        given["observers"],
        given["plants"],
        length,
        arguments.force,
    )
    experiment = what[0].experiment
    there = directory(experiment, arguments.out, prefix="compare-")
    console = err if arguments.json else out
    with bar(console, arguments.json) as progress:
        runs = [c for c in what if not c.refusal]
        task = progress.add_task("samples", total=len(runs) * experiment.samples)
        rows = compare.run(what, lambda k: progress.update(task, completed=k))
    from pea_report.overview import compared

    compare.write(there, experiment.name, rows, experiment.samples * experiment.T_s)
    compared(there / "compare.html", experiment.name, rows, experiment.samples * experiment.T_s)
    if arguments.json:
        told = [compare.without_curve(row) for row in rows]
        print(json.dumps({"experiment": experiment.name, "rows": told}), flush=True)
        return 0
    for title, group in compare.groups(rows).items():
        for table in side_by_side(*compare.table(group), out.width):
            table.title = f"{title}, error in nm"
            out.print(table)
    out.print(f"compare.csv, .json, .png, .svg, .html in {there}", highlight=False)
    return 0


def side_by_side(heads: list[str], cells: list[list[str]], width: int) -> list[Table]:
    """Tables that fit a width with every number whole: the first column stands in each of them.

    The column without a head holds text, which is folded.
    """
    longest = [
        max(len(part) for part in (*head.split(), *(cell for cell in column), ""))
        for head, column in zip(heads, zip(*cells, strict=True), strict=True)
    ]
    name = min(longest[0], width // 3)
    rooms = [TEXT_MIN if not head else room for head, room in zip(heads, longest, strict=True)]
    groups: list[list[int]] = [[]]
    for i, room in enumerate(rooms[1:], 1):
        taken = name + GAP + sum(rooms[j] + GAP for j in groups[-1])
        if groups[-1] and taken + room + GAP > width:
            groups.append([])
        groups[-1].append(i)
    tables = []
    for group in groups:
        table = Table(title_justify="left", box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
        table.add_column(heads[0], overflow="fold", width=name)
        for i in group:
            table.add_column(heads[i], overflow="fold", width=rooms[i] if heads[i] else None)
        for row in cells:
            table.add_row(row[0], *(row[i] for i in group))
        tables.append(table)
    return tables


COMMANDS: dict[str, Callable[[argparse.Namespace], int]] = {"compare": _compare}
