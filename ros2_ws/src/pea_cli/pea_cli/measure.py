"""``pea measure``: what a stage is, and what its running loop is.

Exit status: 0 done, 2 bad input (one line, nothing moved), 3 the run failed, 130 interrupted.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rich.table import Table

from pea_cli.options import number, path_of, sets, timed, whole
from pea_core.config import MODES
from pea_core.console import bar, err, out
from pea_core.entry import line_of
from pea_core.loop import LoopFault
from pea_core.params import ParameterError, nearest
from pea_core.printable import printable
from pea_core.units import NM

WHAT = {
    "loop": "T, S and L of the running loop, margins beside those predicted",
    "response": "frequency response of the stage from voltage to displacement",
    "steps": "steps of several sizes: rise, settling, overshoot",
    "hysteresis": "slow triangles: major and minor loops, linearity",
    "creep": "creep after a small step",
    "noise": "noise at rest: density, Allan deviation, resolution",
}


def add(commands: Any) -> None:
    """Add the command to the parser's."""
    measures = commands.add_parser("measure", help="measure a stage, or its running loop")
    kinds = measures.add_subparsers(dest="kind", metavar="WHAT", required=True)
    made = {name: kinds.add_parser(name, help=text) for name, text in WHAT.items()}
    for name, parser in made.items():
        common(parser)
        if name in ("loop", "response"):
            parser.add_argument("--signal", help="multisine, chirp or stepped_sine")
            parser.add_argument("--amplitude", metavar="X", help="V; um at the reference")
            parser.add_argument("--from", dest="low", metavar="HZ", help="lowest frequency")
            parser.add_argument("--to", dest="high", metavar="HZ", help="highest frequency")
            parser.add_argument(
                "--lines", metavar="N", help="number of frequencies, logarithmically spaced"
            )
            parser.add_argument("--period", metavar="S", help="period of the signal")
            parser.add_argument("--periods", metavar="N", help="periods measured (default: 4)")
            parser.add_argument("--realisations", metavar="N", help="phases (default: 4)")
        if name in ("steps", "noise"):
            parser.add_argument("--open", action="store_true", help="run in open loop: u = w/K")
    made["loop"].add_argument("--where", default="voltage", help="voltage (default) or reference")
    made["steps"].add_argument("--sizes", default="0.1,1", metavar="UM,UM", help="default: 0.1,1")
    made["steps"].add_argument("--repeats", default="5", help="of each (default: 5)")
    made["steps"].add_argument("--hold", default="0.1", metavar="S", help="default: 0.1")
    made["steps"].add_argument("--band", metavar="NM", help="band for settling (default: 2 %%)")
    made["hysteresis"].add_argument("--from", dest="low", metavar="UM", help="lower end")
    made["hysteresis"].add_argument("--to", dest="high", metavar="UM", help="upper end")
    made["hysteresis"].add_argument("--period", default="2", metavar="S", help="of a loop")
    made["hysteresis"].add_argument("--loops", default="2", metavar="N", help="major loops")
    made["creep"].add_argument("--size", metavar="UM", help="step (default: a tenth)")
    made["creep"].add_argument("--hold", default="5", metavar="S", help="default: 5")
    made["noise"].add_argument("--seconds", default="2", metavar="S", help="default: 2")


def common(parser: Any) -> None:
    """Options of every measurement."""
    parser.add_argument(
        "experiment",
        metavar="EXPERIMENT",
        nargs="?",
        default="sine_series",
        help="experiment with the plant and loop (default: sine_series)",
    )
    parser.add_argument("--rig", metavar="NAME", help="rig to drive, from config/rigs/")
    parser.add_argument("--mode", help=f"{', '.join(MODES)} (default: batch; a rig distributed)")
    parser.add_argument("--clock", help="unpaced or wall (default: unpaced; with a rig wall)")
    parser.add_argument("--at", metavar="UM", help="operating point (default: middle)")
    parser.add_argument("--out", metavar="DIR", type=path_of, help="new directory of the run")
    parser.add_argument("--json", action="store_true", help="print the figures, and only them")
    parser.add_argument("--dry-run", action="store_true", help="print the planned motion and exit")
    sets(parser)


def mode_of(arguments: argparse.Namespace) -> tuple[str, dict[str, Any]]:
    """Mode and its options.

    Raises
    ------
    ParameterError
        No such mode or clock, or one that does not go with a rig.
    """
    wall = timed(arguments)
    return arguments.mode, {"wall": True, "cpu": None} if wall else {}


def _optional(
    arguments: argparse.Namespace, name: str, option: str, low: float, high: float, unit: str
) -> float | None:
    text = getattr(arguments, name)
    return None if text is None else number(option, text, low, high, unit)


def _inject(arguments: argparse.Namespace) -> dict[str, Any]:
    where = getattr(arguments, "where", "voltage")
    if where not in ("voltage", "reference"):
        raise ParameterError(f"--where {where!r}: {nearest(where, ('voltage', 'reference'))}")
    found: dict[str, Any] = {"where": where}
    if arguments.signal is not None:
        found["kind"] = arguments.signal
    size = "amplitude_V" if where == "voltage" else "amplitude_um"
    for name, key, option, unit in (
        ("amplitude", size, "--amplitude", ""),
        ("low", "from_hz", "--from", "Hz"),
        ("high", "to_hz", "--to", "Hz"),
        ("period", "period", "--period", "s"),
    ):
        value = _optional(arguments, name, option, 1e-9, 1e6, unit)
        if value is not None:
            found[key] = value
    for name, high in (("lines", 100_000), ("periods", 10_000), ("realisations", 1000)):
        text = getattr(arguments, name)
        if text is not None:
            found[name] = whole(f"--{name}", text, 1, high)
    return found


def planned(arguments: argparse.Namespace) -> Any:
    """The measurement that is asked for, checked."""
    from pea_measure import plans

    base = plans.Base(arguments.experiment, tuple(arguments.sets), arguments.rig)
    at = _optional(arguments, "at", "--at", -1e4, 1e4, "um")
    kind = arguments.kind
    if kind in ("loop", "response"):
        return plans.injected(base, kind, at, _inject(arguments))
    if kind == "steps":
        sizes = [number("--sizes", each, -1e4, 1e4, "um") for each in arguments.sizes.split(",")]
        repeats = whole("--repeats", arguments.repeats, 1, 1000)
        hold = number("--hold", arguments.hold, 1e-3, 1e4, "s")
        made = plans.steps(base, at, sizes, repeats, hold, arguments.open)
        band = _optional(arguments, "band", "--band", 1e-3, 1e6, "nm")
        made.settings["band_m"] = None if band is None else band * NM
        return made
    if kind == "hysteresis":
        low = _optional(arguments, "low", "--from", -1e4, 1e4, "um")
        high = _optional(arguments, "high", "--to", -1e4, 1e4, "um")
        period = number("--period", arguments.period, 1e-3, 1e5, "s")
        return plans.hysteresis(base, low, high, period, whole("--loops", arguments.loops, 1, 100))
    if kind == "creep":
        size = _optional(arguments, "size", "--size", -1e4, 1e4, "um")
        return plans.creep(base, at, size, number("--hold", arguments.hold, 0.1, 1e5, "s"))
    seconds = number("--seconds", arguments.seconds, 0.01, 1e5, "s")
    return plans.noise(base, at, seconds, arguments.open)


def carried_out(
    measurement: Any, mode: str, options: dict[str, Any], there: Any, quiet: bool
) -> tuple[Any, dict[str, Any]]:
    """Carry out a measurement with a bar; its directory and figures."""
    from pea_run.measuring import carry_out

    with bar(err if quiet else out, quiet) as shown:
        task = shown.add_task(measurement.kind, total=measurement.experiment.samples)
        return carry_out(
            measurement, mode, there, lambda k: shown.update(task, completed=k), **options
        )


def attempted(work: Callable[[], int], resumed: Path | None = None) -> int:
    """Do work that moves a stage; exit status 3 and one line where it fails.

    Parameters
    ----------
    work
        What moves the stage; returns the exit status.
    resumed
        Directory in which the same command can go on, if it can.
    """
    from pea_plant.gate import UnsafeCommand
    from pea_record.recording import BagError

    try:
        return work()
    except KeyboardInterrupt:
        err.print("interrupted; what was recorded stays")
        status = 130
    except (LoopFault, UnsafeCommand, BagError, OSError, MemoryError) as error:
        err.print(f"pea: {printable(line_of(error) or error)}")
        status = 3
    if resumed is not None:
        err.print(f"to go on: the same command with --out {resumed}", markup=False, soft_wrap=True)
    return status


def show(found: dict[str, Any]) -> None:
    """Print the figures of a measurement."""
    from pea_measure import analysis

    rows = analysis.table({n: v for n, v in found.items() if n != "sample_period_ns"})
    if rows:
        table = Table("", "value", "unit", title=found["kind"], title_justify="left")
        for row in rows:
            table.add_row(*row)
        out.print(table)
    if found.get("margins"):
        heads = ("", "measured", "95 %", "pea check", "at the slope of H", "unit")
        table = Table(*heads, title="margins", title_justify="left")
        for margin in analysis.margin_table(found):
            table.add_row(*margin)
        out.print(table)
    if found.get("steps"):
        heads = ("step (um)", "n", "rise (ms)", "settling (ms)", "overshoot (%)", "error (nm)")
        table = Table(*heads, title="steps", title_justify="left")
        for cells in analysis.step_table(found):
            table.add_row(*cells)
        out.print(table)
    for name in ("minor_loops", "resolution"):
        if found.get(name):
            table = Table(*found[name][0], title=name.replace("_", " "), title_justify="left")
            for each in found[name]:
                table.add_row(*(f"{value:.4g}" for value in each.values()))
            out.print(table)


def _measure(arguments: argparse.Namespace) -> int:
    mode, options = mode_of(arguments)
    from pea_experiment.checks import refuse_driver

    measurement = planned(arguments)
    if options and not arguments.dry_run:
        refuse_driver(measurement.experiment)
    (err if arguments.json else out).print(measurement.announced(), highlight=False)
    if arguments.dry_run:
        return 0

    def work() -> int:
        there, found = carried_out(measurement, mode, options, arguments.out, arguments.json)
        if arguments.json:
            print(json.dumps(found), flush=True)
        else:
            show(found)
            out.print(
                f"figures  {there}/measurement.json, {there}/measurement.png\nrun      {there}"
            )
        return 0

    return attempted(work)


COMMANDS = {"measure": _measure}
