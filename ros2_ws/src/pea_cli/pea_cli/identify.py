"""``pea identify`` and ``pea simulate-from``: from measured data to a model, and back.

Exit status: 0 done, 2 bad input (one line).
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.table import Table

from pea_cli.bag import one_line
from pea_cli.options import number, path_of, whole
from pea_core.console import err, out
from pea_core.params import ParameterError


def add(commands: Any) -> None:
    """Add the commands to the parser's."""
    identify = commands.add_parser("identify", help="a model of a stage from measured data")
    identify.add_argument(
        "files",
        metavar="FILE",
        nargs="+",
        type=path_of,
        help="recording, CSV, MATLAB, HDF5 or NumPy file",
    )
    _columns(identify)
    identify.add_argument(
        "--kind", default="", help="periodic, general, slow, step, rest (default: found from u)"
    )
    identify.add_argument("--period", metavar="N", help="samples in a period of periodic data")
    identify.add_argument(
        "--modes", metavar="N", default="6", help="most modes to try (default: 6)"
    )
    identify.add_argument(
        "--hysteresis", metavar="A,B", default="", help="models of H to compare (default: all)"
    )
    identify.add_argument(
        "--hold",
        default="zero_order",
        help="u between samples: zero_order or band_limited (default: zero_order)",
    )
    identify.add_argument("--out", metavar="DIR", type=path_of, help="new directory")
    identify.add_argument("--json", action="store_true", help="print the numbers, and only them")
    drives = commands.add_parser(
        "simulate-from", help="drive a model with a measured voltage, compare with the measured y"
    )
    drives.add_argument("file", metavar="FILE", type=path_of, help="as for identify")
    drives.add_argument(
        "--plant",
        metavar="FILE",
        type=path_of,
        help="plant.yaml or axes.json, as identify writes them (default: that of the recording)",
    )
    drives.add_argument(
        "--set",
        metavar="PARAM=VALUE",
        action="append",
        default=[],
        dest="sets",
        help="change a parameter of the plant; may be repeated",
    )
    _columns(drives)
    drives.add_argument("--out", metavar="PNG", type=path_of, help="figure of both, and the error")
    drives.add_argument("--json", action="store_true", help="print the figures, and only them")


def _columns(command: Any) -> None:
    command.add_argument("--u", metavar="NAME:UNIT", default="", help="column of the voltage")
    command.add_argument("--y", metavar="NAME:UNIT", default="", help="column of the displacement")
    command.add_argument("--time", metavar="NAME:UNIT", default="", help="column of the time")
    command.add_argument(
        "--rate", metavar="HZ", help="samples a second, if the file does not contain it"
    )


def _asked(arguments: argparse.Namespace) -> Any:
    from pea_identify.files import Asked

    rate = 0.0
    if arguments.rate is not None:
        rate = number("--rate", arguments.rate, 1e-3, 1e9, "Hz")
    kind, period = getattr(arguments, "kind", ""), getattr(arguments, "period", None)
    samples = 0 if period is None else whole("--period", period, 2, 10**9)
    return Asked(arguments.u, arguments.y, arguments.time, rate, kind, samples)


def _identify(arguments: argparse.Namespace) -> int:
    from pea_identify import axes, page, results
    from pea_identify.modes import HOLDS
    from pea_identify.stage import identify
    from pea_report.measured import read

    most = whole("--modes", arguments.modes, 1, 30)
    if arguments.hold not in HOLDS:
        raise ParameterError(f"--hold {arguments.hold!r}: must be one of {', '.join(HOLDS)}")
    types = tuple(t.strip() for t in arguments.hysteresis.split(",") if t.strip())
    there = arguments.out or Path("runs") / f"identify-{time.strftime('%Y%m%d-%H%M%S')}"
    if there.exists():
        raise ParameterError(f"--out {there}: already exists; name a new directory")
    asked = _asked(arguments)
    records = []
    for path in arguments.files:
        found = read(path, asked)
        err.print(found.understood, highlight=False, markup=False)
        records += found.records
    if any(r.u.shape[1] > 1 or r.y.shape[1] > 1 for r in records):
        several = axes.identify(records)
        there.mkdir(parents=True)
        text = json.dumps(axes.numbers(several), indent=1)
        (there / "axes.json").write_text(text + "\n")
        if arguments.json:
            print(text, flush=True)
        else:
            out.print(axes.sentence(several), highlight=False, markup=False)
            out.print(f"numbers {there}/axes.json", highlight=False, markup=False)
        return 0
    stage = identify(records, most, types, arguments.hold)
    made = results.write(stage, there)
    made.append(page.write(stage, there / "page.html", ", ".join(p.name for p in arguments.files)))
    told = results.numbers(stage)
    if arguments.json:
        print(json.dumps(told), flush=True)
        return 0
    out.print(_table(told))
    for sentence in told["not_determined"]:
        out.print(sentence, highlight=False, markup=False)
    for path in made:
        out.print(f"{path.stem:9} {path}", highlight=False, markup=False)
    return 0


def _table(told: dict[str, Any]) -> Table:
    """The numbers that a reader looks for first."""
    table = Table("", "value", "95 %", "unit", box=SIMPLE_HEAD)

    def row(name: str, value: dict[str, float], unit: str) -> None:
        half = (value["high_95"] - value["low_95"]) / 2.0
        table.add_row(name, f"{value['value']:.6g}", f"± {half:.2g}", unit)

    if "gain_um_per_V" in told:
        row("gain for small signals", told["gain_um_per_V"], "um/V")
    for i, mode in enumerate(told.get("modes", []), 1):
        row(f"mode {i}: frequency", mode["frequency_hz"], "Hz")
        row(f"mode {i}: damping", mode["damping"], "")
        row(f"mode {i}: gain", mode["gain_um_per_V"], "um/V")
    if "delay_us" in told:
        row("delay", told["delay_us"], "us")
        error = told["response"]["held_out_error_percent"]
        if error is not None:
            table.add_row("response, not fitted", f"{error:.3g}", "", "% error")
    if "amplifier_bandwidth_hz" in told:
        row("amplifier bandwidth", told["amplifier_bandwidth_hz"], "Hz")
    if "hysteresis" in told:
        H = told["hysteresis"]
        error = H["held_out_percent"]
        table.add_row("hysteresis", H["type"], "", "")
        error = "-" if error is None else f"{error:.3g}"
        table.add_row("hysteresis, not fitted", error, "", "% of stroke")
    if "creep" in told:
        row("creep, in all", told["creep"]["total"], "")
    if "noise" in told:
        row("sensor noise", told["noise"]["rms_nm"], "nm")
    return table


def _simulate(arguments: argparse.Namespace) -> int:
    from pea_identify.results import misfit
    from pea_report import measured

    found = measured.read(arguments.file, _asked(arguments))
    err.print(found.understood, highlight=False, markup=False)
    record = found.records[0]
    if record.u.shape[1] > 1 or record.y.shape[1] > 1:
        return _simulate_axes(arguments, found.records)
    y, source = measured.driven(record, arguments.file, arguments.plant, arguments.sets)
    figures = {"plant": source, "samples": len(y), **misfit(record.y[:, 0], y)}
    if arguments.out is not None:
        measured.draw(record, y, arguments.out)
        figures["figure"] = str(arguments.out)
    if arguments.json:
        print(json.dumps(figures), flush=True)
        return 0
    table = Table("", "value", box=SIMPLE_HEAD)
    for name, value in figures.items():
        table.add_row(name, f"{value:.6g}" if isinstance(value, float) else str(value))
    out.print(table)
    return 0


def _simulate_axes(arguments: argparse.Namespace, records: Any) -> int:
    """Several axes: the identified rational model stands in place of a plant."""
    from pea_identify import axes

    if arguments.plant is None or arguments.sets or arguments.out is not None:
        raise ParameterError(
            f"{arguments.file.name}: several axes: give --plant axes.json of pea identify, and "
            "neither --set nor --out"
        )
    found = axes.compared(axes.loaded(arguments.plant), records)
    if arguments.json:
        print(json.dumps(found), flush=True)
        return 0
    table = Table("record", "rms V", "NRMSE of each axis (%)", box=SIMPLE_HEAD)
    for row in found["records"]:
        each = " ".join(f"{x:.3g}" for x in row["nrmse_percent"])
        table.add_row(row["name"], f"{row['rms_V']:.4g}", each)
    out.print(table)
    out.print(
        f"mean NRMSE {found['mean_nrmse_percent']:.3g} %, {found['parameters']} parameters",
        highlight=False,
    )
    return 0


COMMANDS = {"identify": one_line(_identify), "simulate-from": one_line(_simulate)}
