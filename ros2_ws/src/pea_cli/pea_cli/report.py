"""``pea report``: recordings as one page.

Exit status: 0 written, 2 bad input (one line).
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from pea_cli.bag import one_line
from pea_cli.options import path_of
from pea_core.console import out
from pea_core.params import ParameterError


def add(commands: Any) -> None:
    """Add the command to the parser's."""
    reports = commands.add_parser("report", help="recordings as one HTML page, and a PNG")
    reports.add_argument(
        "bags", metavar="BAG", nargs="+", type=path_of, help="directory, or MCAP file"
    )
    reports.add_argument(
        "--out", metavar="FILE.html", type=path_of, help="new file (default: in the first bag)"
    )
    reports.add_argument("--json", action="store_true", help="print files and metrics as JSON")


def _report(arguments: argparse.Namespace) -> int:
    from pea_report import report as page

    bags: list[Path] = arguments.bags
    twice = [path for path in bags if bags.count(path) > 1]
    if twice:
        raise ParameterError(f"{twice[0]} stands there twice")
    if arguments.out is not None:
        page.check(arguments.out)
    entries = [page.entry(path, name) for path, name in zip(bags, page.names(bags))]
    first = bags[0]
    there = arguments.out or page.free(first if first.is_dir() else first.parent)
    page.write(there, entries)
    picture = there.with_suffix(".png")
    if arguments.json:
        metrics = {str(entry.path): entry.run.figures for entry in entries}
        print(json.dumps({"html": str(there), "png": str(picture), "metrics": metrics}), flush=True)
    else:
        out.print(f"report  {there}\nfigure  {picture}", highlight=False, markup=False)
    return 0


COMMANDS = {"report": one_line(_report)}
