"""The command line: ``pea``.

Exit status: 0 done, 2 bad input (one line), 3 the run failed, 130 interrupted.
"""

from __future__ import annotations

if __name__ == "__main__":  # nothing is imported before it is known from where
    from pea_cli import __main__ as first

    raise SystemExit(first.main())

import argparse
import dataclasses
import io
import json
import os
import signal
import sys
from collections.abc import Sequence
from concurrent.futures import BrokenExecutor
from itertools import takewhile
from typing import Any, NoReturn

from rich.box import SIMPLE_HEAD
from rich.table import Column, Table
from rich.text import Text

from pea_cli import (
    accept as accept_cli,
)
from pea_cli import (
    bag as bag_cli,
)
from pea_cli import (
    bench as bench_cli,
)
from pea_cli import (
    commission as commission_cli,
)
from pea_cli import (
    dashboard as dashboard_cli,
)
from pea_cli import (
    emulate as emulate_cli,
)
from pea_cli import (
    identify as identify_cli,
)
from pea_cli import (
    measure as measure_cli,
)
from pea_cli import (
    param as param_cli,
)
from pea_cli import (
    report as report_cli,
)
from pea_cli import (
    tune as tune_cli,
)
from pea_cli.options import number, path_of, whole
from pea_core import config, registry
from pea_core.config import NAMESPACE, NODES
from pea_core.console import bar, err, out, silence
from pea_core.entry import FAILED, line_of
from pea_core.interrupt import INTERRUPT
from pea_core.loop import LoopFault
from pea_core.params import Choice, ParameterError, nearest
from pea_core.printable import printable
from pea_engine.compiled import WORTH, wanted
from pea_experiment import experiments, rig
from pea_experiment.experiments import SCHEMAS, Experiment
from pea_experiment.metrics import unit
from pea_plant import drivers
from pea_plant.gate import UnsafeCommand
from pea_record.origin import VERSION
from pea_record.read import BagError
from pea_ros import graph
from pea_wire.topics import RECORDER

BAD_INPUT = 2
"""Exit status where nothing was started."""

MODES = ("batch", "composed", "distributed")
CLOCKS = ("unpaced", "wall")

NODE_HELP = """usage: pea node {node} [--ros-args ARGUMENT ...]

Run the node {node}, as ros2 run does, until Ctrl-C. ARGUMENT is one of ROS:
  --params-file FILE   parameters, for example config/experiments/NAME.yaml
  -p NAME:=VALUE       one parameter; docs/parameters.md lists them
  -r FROM:=TO          another name; -r __ns:=/NAMESPACE another namespace"""

DURATION_MIN, DURATION_MAX = 1e-9, 1e6
"""Seconds of loop time that a run may have; an experiment knows its own rule besides."""

SEED_MAX = 2**31 - 1

DESCRIBED_MAX = 200
"""Characters of an experiment's description that are shown."""

TEXT_MIN, GAP = 20, 2
"""Characters that text takes beside numbers, and that stand between two columns."""

PARTS = (
    accept_cli,
    bag_cli,
    bench_cli,
    commission_cli,
    dashboard_cli,
    emulate_cli,
    identify_cli,
    measure_cli,
    param_cli,
    report_cli,
    tune_cli,
)
"""Modules with commands of their own: ``add(commands)`` and ``COMMANDS``. They import what is
heavy when a command runs."""


class _Parser(argparse.ArgumentParser):
    """Says what is wrong in one line."""

    def error(self, message: str) -> NoReturn:
        raise ParameterError(f"{message} (see {self.prog} --help)")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="pea", description="Control of piezoelectric actuators with ROS 2.")
    parser.add_argument("--version", action="version", version=f"pea {VERSION}")
    commands = parser.add_subparsers(dest="command", parser_class=_Parser)
    lists = commands.add_parser("list", help="what there is to run and to choose from")
    lists.add_argument("--json", action="store_true", help="as JSON")
    runs = commands.add_parser("run", help="run an experiment")
    runs.add_argument("experiment", metavar="EXPERIMENT", help="name, or path of a YAML file")
    modes = ", ".join(MODES)
    runs.add_argument("--mode", help=f"{modes} (default: batch; with a rig distributed)")
    runs.add_argument("--clock", help=f"{', '.join(CLOCKS)} (default: unpaced; with a rig wall)")
    runs.add_argument("--cpu", metavar="N", help="core for the loop in wall time")
    runs.add_argument(
        "--namespace", help=f"of its nodes and topics; not in batch (default: {NAMESPACE})"
    )
    runs.add_argument("--duration", metavar="S", help="seconds of loop time")
    runs.add_argument("--seed", metavar="N", help="seed of the sensor noise")
    runs.add_argument("--out", metavar="DIR", type=path_of, help="new directory of the run")
    runs.add_argument("--split-size", metavar="SIZE", help="new file of the bag after so much")
    runs.add_argument("--split-duration", metavar="S", help="new file after so much loop time")
    runs.add_argument(
        "--no-record",
        action="store_false",
        dest="recorded",
        help="leave no bag, and so hardly any metrics; not in batch",
    )
    runs.add_argument("--json", action="store_true", help="print the metrics, and only them")
    runs.add_argument("--force", action="store_true", help="run a loop that is unstable in theory")
    checks = commands.add_parser("check", help="what theory says of an experiment's loop")
    checks.add_argument("experiment", metavar="EXPERIMENT", help="name, or path of a YAML file")
    checks.add_argument("--json", action="store_true", help="as JSON")
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
    compares.add_argument("--force", action="store_true", help="run what is unstable in theory too")
    for command in (runs, checks):
        command.add_argument("--rig", metavar="NAME", help="what to drive, from config/rigs/")
    for command in (runs, checks, compares):
        command.add_argument(
            "--set",
            metavar="NODE.PARAM=VALUE",
            action="append",
            default=[],
            dest="sets",
            help="change a parameter; may be repeated",
        )
    for part in PARTS:
        part.add(commands)
    doctors = commands.add_parser("doctor", help="what this machine can hold in wall time")
    doctors.add_argument("--cpu", metavar="N", help="core to measure on")
    doctors.add_argument("--seconds", metavar="S", default="2", help="how long (default: 2)")
    doctors.add_argument("--json", action="store_true", help="as JSON")
    node = commands.add_parser("node", help="run one node, as ros2 run does")
    node.add_argument("node", metavar="NODE", help=", ".join((*NODES, RECORDER)))
    node.add_argument("arguments", nargs=argparse.REMAINDER, metavar="...")
    return parser


def _duration(arguments: argparse.Namespace) -> float | None:
    if arguments.duration is None:
        return None
    return number("--duration", arguments.duration, DURATION_MIN, DURATION_MAX, "s")


def _seed(arguments: argparse.Namespace) -> int | None:
    return None if arguments.seed is None else whole("--seed", arguments.seed, 0, SEED_MAX)


def _cpu(arguments: argparse.Namespace) -> int | None:
    cpus = sorted(os.sched_getaffinity(0))
    known = {str(cpu): cpu for cpu in cpus}
    if arguments.cpu is None or arguments.cpu in known:
        return known.get(arguments.cpu)
    raise ParameterError(f"--cpu {printable(arguments.cpu, 20)}: must be one of {', '.join(known)}")


def _clock(arguments: argparse.Namespace) -> dict[str, Any]:
    """Options of the mode."""
    if arguments.clock not in CLOCKS:
        raise ParameterError(
            f"unknown clock {arguments.clock!r}: {nearest(arguments.clock, CLOCKS)}"
        )
    cpu = _cpu(arguments)
    if arguments.clock == "wall":
        if arguments.mode == "batch":
            raise ParameterError(
                "--clock wall: mode batch has no wall time; add --mode composed or distributed"
            )
        return {"wall": True, "cpu": cpu}
    if cpu is not None:
        raise ParameterError(f"--cpu {cpu}: is for wall time; add --mode composed --clock wall")
    return {}


def _namespace(arguments: argparse.Namespace) -> dict[str, str]:
    """Option of the modes with nodes: where these are."""
    if arguments.namespace is None:
        return {}
    if arguments.mode == "batch":
        raise ParameterError(
            f"--namespace {printable(arguments.namespace, 80)}: mode batch has no nodes; add "
            "--mode composed or distributed"
        )
    return {"namespace": param_cli.space(arguments.namespace)}


def _split(arguments: argparse.Namespace) -> dict[str, Any]:
    """Option of every mode: when the recording goes on in a new file."""
    if arguments.split_size is None and arguments.split_duration is None:
        return {}
    from pea_record.bag import split_of

    return {"split": split_of(arguments.split_size, arguments.split_duration)}


def _run(arguments: argparse.Namespace) -> int:
    arguments.mode = arguments.mode or ("distributed" if arguments.rig else "batch")
    arguments.clock = arguments.clock or ("wall" if arguments.rig else "unpaced")
    if arguments.mode not in MODES:
        raise ParameterError(f"unknown mode {arguments.mode!r}: {nearest(arguments.mode, MODES)}")
    if arguments.rig and (arguments.mode == "batch" or arguments.clock == "unpaced"):
        option = "--mode batch" if arguments.mode == "batch" else "--clock unpaced"
        raise ParameterError(f"{option}: a rig runs on the clock; leave it away")
    if arguments.mode == "batch" and not arguments.recorded:
        raise ParameterError("--no-record: mode batch is there to be recorded")
    options = _clock(arguments)
    more = {**_split(arguments), **_namespace(arguments)}
    duration = _duration(arguments)
    seed = _seed(arguments)
    name, sets = arguments.experiment, arguments.sets
    experiment = experiments.load(name, sets, duration, seed, rig=arguments.rig)
    if not arguments.force:
        from pea_lab.check import refuse_unstable
        from pea_lab.settling import oscillation

        refuse_unstable(experiment)
        if seen := oscillation(experiment):
            err.print(f"pea: warning: {experiment.name}: {seen}", highlight=False, markup=False)
    if arguments.mode != "batch":
        graph.check_domain()
    from pea_run.run import directory, run

    samples = WORTH if options else experiment.samples
    compiles = arguments.mode != "distributed" and wanted(samples)
    there = directory(experiment, arguments.out)
    console = err if arguments.json else out
    mode = f"{arguments.mode}, wall time" if options else arguments.mode
    console.print(_headline(experiment, mode))
    for note in experiment.notes:
        err.print(note)
    left = f"what was recorded is in {there}" if arguments.recorded else "nothing was recorded"
    try:
        with bar(console, arguments.json) as progress:
            first = "compiling the loop, once" if compiles else "samples"
            task = progress.add_task(first, total=experiment.samples)
            figures = run(
                experiment,
                arguments.mode,
                there,
                lambda k: progress.update(task, completed=k, description="samples"),
                recorded=arguments.recorded,
                **options,
                **more,
            )
    except KeyboardInterrupt:
        err.print(f"interrupted; {left}")
        return 130
    except (LoopFault, UnsafeCommand, BagError, OSError, MemoryError) as error:
        err.print(f"pea: {printable(line_of(error) or error)}")
        err.print(left)
        return 3
    warnings = list(figures.get("warnings", ()))
    if arguments.recorded and (small := experiments.too_small(experiment, figures)):
        warnings.append(small)
    for warning in warnings:
        err.print(f"pea: warning: {warning}")
    if arguments.json:
        print(json.dumps(figures), flush=True)
    else:
        out.print(_table(figures))
        if arguments.recorded:
            out.print(f"report  {there}/report.png\nbag     {there}")
    return 0


def _check(arguments: argparse.Namespace) -> int:
    from pea_lab.check import check, rows, stepped
    from pea_observer.matching import matching

    experiment = experiments.load(arguments.experiment, arguments.sets, rig=arguments.rig)
    figures = stepped(experiment, check(experiment))
    if arguments.json:
        print(json.dumps(figures), flush=True)
        return 0
    table = Table("", "value", "unit", title=experiment.name, title_justify="left")
    for row in rows(figures):
        table.add_row(*row)
    out.print(table)
    for line in (str(matching(experiment.nominal, experiment.T_s)), figures["note"]):
        if line:
            out.print(line)
    return 0


def _doctor(arguments: argparse.Namespace) -> int:
    from pea_run import doctor

    cpu = _cpu(arguments)
    seconds = number("--seconds", arguments.seconds, 0.1, 3600.0, "s")
    findings = doctor.findings(cpu)
    deadlines = doctor.measure(seconds, cpu)
    if arguments.json:
        rows = [finding._asdict() for finding in findings]
        figures = {**deadlines.figures(), **deadlines.conditions}
        print(json.dumps({"findings": rows, "empty_loop": figures}), flush=True)
        return 0
    table = Table("", "found", "to change", title="This machine", title_justify="left")
    for finding in findings:
        style = "green" if finding.fine else "yellow"
        table.add_row(finding.what, Text(finding.found, style), finding.advice or "fine")
    out.print(table)
    loop = Table("empty loop", "value", "unit", title="Measured at 20 kHz", title_justify="left")
    for name, value in deadlines.figures().items():
        told = f"{value:.6g}" if isinstance(value, float) else str(value)
        loop.add_row(name, told, unit(name))
    out.print(loop)
    out.print(doctor.verdict(deadlines))
    return 0


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

    duration = _duration(arguments)
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
        duration,
        arguments.force,
    )
    experiment = what[0].experiment
    there = directory(experiment, arguments.out, prefix="compare-")
    console = err if arguments.json else out
    with bar(console, arguments.json) as progress:
        runs = [c for c in what if not c.refusal]
        task = progress.add_task("samples", total=len(runs) * experiment.samples)
        rows = compare.run(what, lambda k: progress.update(task, completed=k))
    compare.write(there, experiment.name, rows, experiment.samples * experiment.T_s)
    if arguments.json:
        told = [compare.without_curve(row) for row in rows]
        print(json.dumps({"experiment": experiment.name, "rows": told}), flush=True)
        return 0
    for title, group in compare.groups(rows).items():
        for table in _side_by_side(*compare.table(group), out.width):
            table.title = f"{title}, error in nm"
            out.print(table)
    out.print(f"compare.csv, compare.json, compare.png in {there}")
    return 0


def _side_by_side(heads: list[str], cells: list[list[str]], width: int) -> list[Table]:
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


def _headline(experiment: Experiment, mode: str) -> Text:
    about = experiment.about
    figure = f" (paper, {about.figure})" if about.figure else ""
    description = printable(about.description, DESCRIBED_MAX)
    return Text.assemble(
        (printable(experiment.name), "bold"),
        f": {description}{printable(figure)}\n"
        f"{mode}, {experiment.samples} samples, T_s = {experiment.T_s * 1e6:g} us",
    )


def _table(figures: dict[str, Any]) -> Table:
    value = Column("value", overflow="fold")  # a digest is compared, so it is shown whole
    table = Table("metric", value, "unit", title="metrics.json", title_justify="left")
    for name, found in figures.items():
        if isinstance(found, float):
            table.add_row(name, f"{found:.6g}", unit(name))
        elif isinstance(found, int | str):
            table.add_row(name, str(found), unit(name), end_section=name == "samples_per_s")
    for name, found in figures.get("deadlines", {}).items():
        told = f"{found:.6g}" if isinstance(found, float) else str(found)
        table.add_row(name, told, unit(name))
    for name, count in figures.get("commands", {}).items():
        table.add_row("periods overrun" if name == "overruns" else f"commands {name}", str(count))
    segments = figures.get("segments", ())
    for segment in segments if len(segments) > 1 else ():
        table.add_row(
            f"rms_error_nm at {segment['frequency_hz']:g} Hz",
            f"{segment['rms_error_nm']:.6g}",
            "nm",
        )
    return table


LISTED = (
    ("controllers", "pea.laws", ""),
    ("observers", "pea.observers", ""),
    ("references", "pea.references", ""),
    ("plants", "pea.hysteresis", "hysteresis.type="),
    ("plants", "pea.creep", "creep.type="),
    ("plants", "pea.vibration", "vibration.type="),
    ("plants", "pea.loads", "load.type="),
    ("drivers", drivers.GROUP, ""),
)
"""Where a list names models of an entry point group, and how it writes them."""


def _lists() -> dict[str, Any]:
    found: dict[str, Any] = {
        "experiments": {name: about.description for name, about in experiments.names().items()}
    }
    for node in NODES:
        schema = SCHEMAS[node]
        if isinstance(schema, Choice):
            found[f"{node}s"] = _kinds(schema)
        else:
            found[f"{node}s"] = {
                f"{field.name}.type={name}": text
                for field in dataclasses.fields(schema)
                if isinstance(choice := field.metadata.get("group"), Choice)
                and choice is not drivers.CHOICE  # they have a list of their own
                for name, text in _kinds(choice).items()
            }
        presets = experiments.presets(node)
        if presets:
            found[f"{node} presets"] = {name: _head(node, name) for name in presets}
    found["drivers"] = _kinds(drivers.CHOICE)
    for title, group, begin in LISTED:
        broken = registry.BROKEN.get(group, {})
        found[title] |= {begin + name: f"cannot be used: {why}" for name, why in broken.items()}
    found["rigs"] = rig.names()
    return found


def _head(node: str, preset: str) -> str:
    """First sentence of the comment at the head of a preset's file."""
    path = config.find(config.FOLDERS[node], preset, preset)
    lines = path.read_text(encoding="utf-8").split("\n")
    comment = " ".join(line.lstrip("# ") for line in takewhile(lambda t: t.startswith("#"), lines))
    sentence, ends, _ = comment.partition(". ")
    return sentence + ends.strip()


def _about(thing: object) -> str:
    """First line of a docstring."""
    return (thing.__doc__ or "").split("\n")[0]


def _kinds(choice: Choice) -> dict[str, str]:
    return {name: _about(kind) for name, kind in choice.kinds.items()}


def _list(arguments: argparse.Namespace) -> int:
    found = _lists()
    if arguments.json:
        print(json.dumps(found), flush=True)
        return 0
    for title, entries in found.items():
        table = Table("name", "", title=title, title_justify="left", show_header=False)
        for name, text in entries.items():
            table.add_row(name, text)
        out.print(table)
    return 0


def _node(arguments: argparse.Namespace) -> int:
    from pea_run.modes.distributed import executable

    known = (*NODES, RECORDER)
    if arguments.node not in known:
        raise ParameterError(f"unknown node {arguments.node!r}: {nearest(arguments.node, known)}")
    given = arguments.arguments
    if given[:1] in (["-h"], ["--help"]):
        out.print(NODE_HELP.format(node=arguments.node))
        return 0
    if given and given[0] != "--ros-args":
        raise ParameterError(
            f"node {arguments.node}: {printable(given[0], 80)!r}: must begin with --ros-args, "
            f"see pea node {arguments.node} --help"
        )
    graph.check_domain()
    path = executable(arguments.node)
    return os.execv(path, [str(path), *arguments.arguments])


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command and return its exit status."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # any name can be shown in any locale
    parser = _parser()
    try:
        arguments = parser.parse_args(argv)
        if arguments.command is None:
            parser.print_help()
            return 0
        for number in (signal.SIGINT, signal.SIGTERM):  # a script's `&` has SIGINT ignored
            signal.signal(number, INTERRUPT)
        commands = {
            "run": _run,
            "check": _check,
            "compare": _compare,
            "doctor": _doctor,
            "list": _list,
            "node": _node,
        }
        for part in PARTS:
            commands |= part.COMMANDS
        return commands[arguments.command](arguments)
    except ParameterError as error:
        err.print(f"pea: {error}")
        return BAD_INPUT
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:
        silence(sys.stdout)
        return 0
    except BrokenExecutor:
        err.print("pea: a worker process was killed: is there memory enough for all of them?")
        return 3
    except Exception as error:
        line = line_of(error)
        if line is None:
            raise
        silence(sys.stdout)
        err.print(f"pea: {printable(line)}")
        return BAD_INPUT if isinstance(error, ModuleNotFoundError) else FAILED
