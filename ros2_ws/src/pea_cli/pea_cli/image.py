"""``pea image``: what the stage has made of a scan, as maps of its error and as a picture.

Exit status: 0 written, 2 bad input (one line).
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from typing import Any

from rich.table import Table

from pea_cli.bag import one_line
from pea_cli.options import number, path_of, whole
from pea_core.console import out
from pea_core.units import NM_PER_M


def add(commands: Any) -> None:
    """Add the command to the parser's."""
    images = commands.add_parser("image", help="error maps and a picture of a recorded scan")
    images.add_argument("bag", metavar="BAG", type=path_of, help="directory, or MCAP file")
    images.add_argument(
        "--out",
        metavar="FILE",
        action="append",
        default=[],
        dest="files",
        type=path_of,
        help="new file: .png, .svg, .npz or .h5; may be repeated (default: image.png in the bag)",
    )
    images.add_argument(
        "--signal",
        metavar="FILE",
        type=path_of,
        help="picture (PNG, JPEG, TIFF, .npy) of the area, sampled at the measured position, in "
        "place of the sample signal that was recorded",
    )
    images.add_argument(
        "--pixels",
        metavar="N",
        default="128",
        help="pixels of each side if the scan is not a raster (default: 128)",
    )
    images.add_argument(
        "--tolerance",
        metavar="NM",
        help="of a list of points: print when all axes stay within this",
    )
    images.add_argument("--json", action="store_true", help="print files and errors as JSON")


def _image(arguments: argparse.Namespace) -> int:
    from pea_report import pictures

    pixels = whole("--pixels", arguments.pixels, 1, pictures.BINS_MAX)
    tolerance = arguments.tolerance
    if tolerance is not None:
        tolerance = number("--tolerance", tolerance, 0.0, 1e9, "nm") / NM_PER_M
    files = arguments.files or [pictures.free(arguments.bag)]
    for file in files:
        pictures.check(file)
    picture = None if arguments.signal is None else pictures.image(arguments.signal)
    run = pictures.load(arguments.bag)
    grey = run.signal if picture is None else picture
    maps = pictures.of_run(run.each, run.samples, run.number, pixels, grey)
    reached = None if tolerance is None else pictures.reached(run, tolerance)
    for file in files:
        pictures.write(file, maps, run.name)
    if arguments.json:
        figures: dict[str, Any] = {
            "files": [str(file) for file in files],
            "pictures": pictures.figures(maps),
        }
        if reached is not None:
            figures["points"] = reached
        print(json.dumps(figures), flush=True)
        return 0
    columns = ("x rms nm", "y rms nm", "distance rms nm", "largest nm")
    table = Table("picture", *columns, title="error of the measured position", title_justify="left")
    for name, *errors in pictures.lines_of(maps):
        table.add_row(name, *(f"{error:.4g}" for error in errors))
    out.print(table)
    for row in reached or ():
        after = row["after_s"]
        told = "not reached" if after is None else f"reached {after * 1e3:.4g} ms after its plan"
        out.print(f"round {row['round']} point {row['point']}: {told}", highlight=False)
    for file in files:
        out.print(f"image   {file}", highlight=False, markup=False)
    return 0


COMMANDS: dict[str, Callable[[argparse.Namespace], int]] = {"image": one_line(_image)}
