"""``pea report``: recordings as one page; ``pea figure``: panels of it as a file for a paper.

Exit status: 0 written, 2 bad input (one line).
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from pea_cli.bag import one_line
from pea_cli.options import path_of
from pea_core.console import out
from pea_core.params import ParameterError, nearest


def add(commands: Any) -> None:
    """Add the command to the parser's."""
    reports = commands.add_parser("report", help="recordings as one HTML page, and a PNG")
    reports.add_argument(
        "bags", metavar="BAG", nargs="+", type=path_of, help="directory, or MCAP file"
    )
    reports.add_argument(
        "--out", metavar="FILE.html", type=path_of, help="new file (default: in the first bag)"
    )
    reports.add_argument(
        "--pdf", metavar="FILE.pdf", type=path_of, help="also its figures as PDF, a page a panel"
    )
    reports.add_argument("--json", action="store_true", help="print files and metrics as JSON")
    figures = commands.add_parser(
        "figure", help="a run's figure, or panels of a report, as PDF, SVG or PNG"
    )
    figures.add_argument("bag", metavar="BAG", type=path_of, help="directory, or MCAP file")
    figures.add_argument(
        "panels", metavar="PANEL", nargs="*", help="tracking, error, … (default: as report.png)"
    )
    figures.add_argument(
        "--with",
        metavar="BAG",
        action="append",
        default=[],
        dest="others",
        type=path_of,
        help="another recording to draw over it; may be repeated",
    )
    figures.add_argument(
        "--out",
        metavar="FILE",
        type=path_of,
        required=True,
        help="new file that ends in .pdf, .svg or .png",
    )


def _new_file(option: str, path: Path, endings: Sequence[str]) -> None:
    """Refuse a name that cannot be written, before anything is read."""
    if path.suffix not in endings:
        raise ParameterError(f"{option} {path}: must end in {', '.join(endings)}")
    if path.exists():
        raise ParameterError(f"{option} {path}: exists already; nothing is written over")


def _figure(arguments: argparse.Namespace) -> int:
    from pea_lab.plot import FORMATS, save_as
    from pea_report import figures, report

    _new_file("--out", arguments.out, FORMATS)
    for name in arguments.panels:
        if name not in figures.BY_NAME:
            raise ParameterError(f"unknown panel {name!r}: {nearest(name, figures.BY_NAME)}")
    bags = [arguments.bag, *arguments.others]
    named = zip(bags, report.names(bags), strict=True)
    entries = [
        replace(entry, run=replace(entry.run, points=figures.FILE_LINE))
        for path, name in named
        for entry in report.entries(path, name)
    ]
    if arguments.panels:
        plot = figures.paper([entry.run for entry in entries], arguments.panels)
    else:
        plot = report.summary(entries)
    save_as(plot, arguments.out)
    out.print(f"figure  {arguments.out}", highlight=False, markup=False)
    return 0


def _report(arguments: argparse.Namespace) -> int:
    from pea_report import report as page

    bags: list[Path] = arguments.bags
    twice = [path for path in bags if bags.count(path) > 1]
    if twice:
        raise ParameterError(f"{twice[0]} is given twice")
    if arguments.out is not None:
        page.check(arguments.out)
    if arguments.pdf is not None:
        _new_file("--pdf", arguments.pdf, (".pdf",))
    named = zip(bags, page.names(bags), strict=True)
    each = {path: page.entries(path, name) for path, name in named}
    entries = [entry for found in each.values() for entry in found]
    first = entries[0].path
    there = arguments.out or page.free(first if first.is_dir() else first.parent)
    page.write(there, entries)
    picture = there.with_suffix(".png")
    if arguments.pdf is not None:
        page.write_pdf(arguments.pdf, entries)
    if arguments.json:
        metrics = {str(path): page.figures_of(found) for path, found in each.items()}
        print(json.dumps({"html": str(there), "png": str(picture), "metrics": metrics}), flush=True)
    else:
        out.print(f"report  {there}\nfigure  {picture}", highlight=False, markup=False)
        if arguments.pdf is not None:
            out.print(f"PDF     {arguments.pdf}", highlight=False, markup=False)
    return 0


COMMANDS = {"report": one_line(_report), "figure": one_line(_figure)}
