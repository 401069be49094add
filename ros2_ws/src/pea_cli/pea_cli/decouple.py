"""``pea decouple``: a matrix, or a filter, that lets each axis of a stage move alone.

Exit status: 0 done, 2 bad input (one line).
"""

from __future__ import annotations

import argparse
import json
import math
from typing import Any

import numpy as np
from rich.table import Table

from pea_cli.options import number, path_of, sets, whole
from pea_core import config
from pea_core.console import out
from pea_core.params import ParameterError

TAPS_MAX = 256
"""Most taps of a filter."""


def add(commands: Any) -> None:
    """Add the command to the parser's."""
    decouples = commands.add_parser(
        "decouple", help="find how to distribute the commands of axes to coupled actuators"
    )
    decouples.add_argument("experiment", metavar="EXPERIMENT", help="of several axes, or a path")
    decouples.add_argument(
        "--taps", metavar="N", default="1", help="of a filter (default: 1, a matrix)"
    )
    decouples.add_argument(
        "--to", metavar="HZ", default="", help="edge of the band (default: 0.8 of the first mode)"
    )
    decouples.add_argument(
        "--out", metavar="FILE", type=path_of, help="new file: the experiment with it"
    )
    decouples.add_argument("--json", action="store_true", help="as JSON")
    sets(decouples)


def _decouple(arguments: argparse.Namespace) -> int:
    from pea_experiment import experiments
    from pea_experiment.experiment import MultiAxis
    from pea_lab.decoupling import decouple, first_mode

    taps = whole("--taps", arguments.taps, 1, TAPS_MAX)
    there = arguments.out
    if there is not None and there.exists():
        raise ParameterError(f"--out {there}: exists; name a new file")
    experiment = experiments.load_axes(arguments.experiment, arguments.sets)
    if not isinstance(experiment, MultiAxis):
        raise ParameterError(f"{arguments.experiment}: has one axis, which nothing couples")
    edge = 0.8 * first_mode(experiment)
    if arguments.to:
        edge = number("--to", arguments.to, 1e-3, 1e9, "Hz")
    found = decouple(experiment, taps, edge)
    values = [float(f"{value:.8g}") for value in found.taps.ravel()]
    if there is not None:
        about = f"# Found by pea decouple {experiment.name}: {taps} taps, up to {edge:.6g} Hz.\n"
        sections = experiment.sections()
        sections["plant"] = {**sections["plant"], "stage.axes_to_actuators": values}
        there.write_text(about + config.dump(sections), encoding="utf-8")
    if arguments.json:
        told = {
            "axes_to_actuators": values,
            "taps": taps,
            "to_hz": edge,
            "frequency_hz": found.f.tolist(),
            "none": found.before.tolist(),
            "static": found.static.tolist(),
            "found": found.after.tolist(),
        }
        print(json.dumps(told), flush=True)
        return 0
    ways = {"none": found.before, "static": found.static}
    if taps > 1:
        ways[f"{taps} taps"] = found.after
    title = f"{experiment.name}, what another axis sees"
    table = Table("up to", *ways, title=title, title_justify="left")
    for share in (0.05, 0.2, 0.4, 0.6, 0.8, 1.0):
        seen = found.f <= share * edge
        cells = (
            f"{20.0 * math.log10(max(np.max(way[seen]), 1e-9)):.1f} dB" for way in ways.values()
        )
        table.add_row(f"{share * edge:.4g} Hz", *cells)
    out.print(table)
    if there is not None:
        out.print(f"the experiment with it: pea run {there}", highlight=False, markup=False)
    elif taps == 1:
        text = ", ".join(f"{value:.6g}" for value in values)
        out.print(f"plant.stage.axes_to_actuators=[{text}]", highlight=False, markup=False)
    else:
        out.print("--out FILE writes the experiment with these taps", highlight=False)
    return 0


COMMANDS = {"decouple": _decouple}
