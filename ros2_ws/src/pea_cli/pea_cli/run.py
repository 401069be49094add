"""``pea run``: one run of an experiment."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from typing import Any

from rich.table import Column, Table
from rich.text import Text

from pea_cli.options import cpu, duration, path_of, seed, sets, timed
from pea_cli.param import space
from pea_core.config import BATCH, CLOCKS, DISTRIBUTED, MODES, NAMESPACE
from pea_core.console import bar, err, out
from pea_core.entry import line_of
from pea_core.loop import LoopFault
from pea_core.params import ParameterError, nearest, number_of
from pea_core.printable import printable
from pea_engine.compiled import WORTH, wanted
from pea_experiment import checks, experiments
from pea_experiment.experiment import AnyExperiment, Experiment, MultiAxis
from pea_experiment.metrics import unit
from pea_plant.gate import UnsafeCommand
from pea_record.recording import BagError
from pea_record.trigger import NO_SCAN, SCANNED, split
from pea_ros import graph

DESCRIBED_MAX = 200
"""Characters of an experiment's description that are shown."""


def add(commands: Any) -> None:
    """Add the command to the parser's."""
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
    runs.add_argument("--split-size", metavar="SIZE", help="start a new bag file at this size")
    runs.add_argument(
        "--split-duration", metavar="S", help="start a new bag file after this much loop time"
    )
    runs.add_argument(
        "--trigger-source",
        metavar="SIGNAL",
        help="record only before and after a trigger: a signal (y, error, u, ...), trip, "
        "parameter, frame, line, pixel or point",
    )
    runs.add_argument("--trigger-level", metavar="X", help="level of the signal: um, nm (error), V")
    runs.add_argument(
        "--trigger-edge", metavar="EDGE", help="rising (default), falling, either, above, below"
    )
    runs.add_argument("--trigger-pre", metavar="S", help="seconds to keep before it (default: 0.1)")
    runs.add_argument("--trigger-post", metavar="S", help="seconds to keep after it (default: 0.1)")
    runs.add_argument(
        "--no-record",
        action="store_false",
        dest="recorded",
        help="record no bag, so most metrics are missing; not in batch",
    )
    runs.add_argument(
        "--no-report",
        action="store_false",
        dest="drawn",
        help="draw no report.png; pea figure draws it from the bag at any time",
    )
    runs.add_argument("--json", action="store_true", help="print the metrics, and only them")
    runs.add_argument("--force", action="store_true", help="run a loop that would be refused")
    runs.add_argument("--rig", metavar="NAME", help="rig to drive, from config/rigs/")
    sets(runs)


def _clock(arguments: argparse.Namespace, wall: bool) -> dict[str, Any]:
    """Options of the mode."""
    core = cpu(arguments)
    if wall:
        return {"wall": True, "cpu": core}
    if core is not None:
        raise ParameterError(f"--cpu {core}: is for wall time; add --mode composed --clock wall")
    return {}


def _namespace(arguments: argparse.Namespace) -> dict[str, str]:
    """Option of the modes with nodes: where these are."""
    if arguments.namespace is None:
        return {}
    if arguments.mode == BATCH:
        raise ParameterError(
            f"--namespace {printable(arguments.namespace, 80)}: mode batch has no nodes; add "
            "--mode composed or distributed"
        )
    return {"namespace": space(arguments.namespace)}


def _split(arguments: argparse.Namespace) -> dict[str, Any]:
    """Option of every mode: when the recording goes on in a new file."""
    if arguments.split_size is None and arguments.split_duration is None:
        return {}
    from pea_record.bag import split_of

    return {"split": split_of(arguments.split_size, arguments.split_duration)}


def _trigger(arguments: argparse.Namespace) -> dict[str, Any]:
    """Option of every mode: what the recording is triggered by."""
    parts = ("source", "level", "edge", "pre", "post")
    given = {part: getattr(arguments, f"trigger_{part}") for part in parts}
    if all(value is None for value in given.values()):
        return {}
    from pea_record.trigger import trigger_of

    for part in ("level", "pre", "post"):
        if given[part] is not None:
            number = number_of(given[part])
            if number is None:
                raise ParameterError(f"--trigger-{part} {given[part]}: give a number")
            given[part] = float(number)
    found = trigger_of(**given, name=lambda part: f"--trigger-{part}")
    if not arguments.recorded:
        raise ParameterError("--trigger-source: nothing is recorded with --no-record; omit one")
    return {"trigger": found}


def _run(arguments: argparse.Namespace) -> int:
    wall = timed(arguments)
    if arguments.mode == BATCH and not arguments.recorded:
        raise ParameterError("--no-record: mode batch only records; omit it")
    options = _clock(arguments, wall)
    more = {**_split(arguments), **_trigger(arguments), **_namespace(arguments)}
    name, length, of_noise = arguments.experiment, duration(arguments), seed(arguments)
    experiment = experiments.load_axes(name, arguments.sets, length, of_noise, rig=arguments.rig)
    checks.refuse_specimen(experiment)
    if wall:
        checks.refuse_driver(experiment)
    if "trigger" in more:
        _look_at_source(experiment, more["trigger"].source)
    if isinstance(experiment, MultiAxis) and not arguments.force:
        from pea_lab.coupled import refuse_unstable

        refuse_unstable(experiment)
    for one in experiment.each:
        _look(one, arguments.force, "" if len(experiment.axes) == 1 else f"{one.axis}: ")
    if arguments.mode != BATCH:
        graph.check_domain()
    from pea_run.run import directory, run

    samples = WORTH if options else experiment.samples
    compiles = arguments.mode != DISTRIBUTED and wanted(samples)
    there = directory(experiment, arguments.out)
    console = err if arguments.json else out
    mode = f"{arguments.mode}, wall time" if options else arguments.mode
    console.print(_headline(experiment, mode))
    for note in experiment.notes:
        err.print(note)
    left = f"what was recorded is in {there}" if arguments.recorded else "nothing was recorded"
    try:
        with bar(console, arguments.json) as progress:
            first = "compiling the loop (once)" if compiles else "samples"
            task = progress.add_task(first, total=experiment.samples)
            figures = run(
                experiment,
                arguments.mode,
                there,
                lambda k: progress.update(task, completed=k, description="samples"),
                recorded=arguments.recorded,
                drawn=arguments.drawn,
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
    whole = arguments.recorded and "trigger" not in more
    _warn(experiment, figures, whole)
    if arguments.json:
        print(json.dumps(figures), flush=True)
    else:
        out.print(table(figures))
        if whole and arguments.drawn:
            out.print(f"report  {there}/report.png")
        if arguments.recorded:
            out.print(f"bag     {there}")
    return 0


def _look_at_source(experiment: AnyExperiment, source: str) -> None:
    """Refuse a trigger source that the experiment does not have."""
    if source in SCANNED and experiment.scan_events is None:
        raise ParameterError(f"--trigger-source {source}: {NO_SCAN}")
    axis = split(source)[0]
    if axis and axis not in experiment.axes:
        known = nearest(axis, experiment.axes)
        raise ParameterError(f"--trigger-source {source}: no axis {axis!r}: {known}")


def _warn(experiment: AnyExperiment, figures: dict[str, Any], whole: bool) -> None:
    """Print the warnings of a run, and of laws whose switching gain was too small for it."""
    warnings = list(figures.get("warnings", ()))
    for one in experiment.each if whole else ():
        own = figures.get("axes", {one.axis: figures})[one.axis]
        if small := checks.too_small(one, own):
            warnings.append(small)
    for warning in warnings:
        err.print(f"pea: warning: {warning}")


def _look(experiment: Experiment, force: bool, axis: str) -> None:
    """Refuse an axis that cannot do what it shall; warn of what is to be expected of it.

    Raises
    ------
    ParameterError
        It is refused (`pea_lab.check.refuse`), and not forced.
    """
    from pea_lab.settling import oscillation, unslewed

    if not force:
        from pea_lab.check import refuse

        refuse(experiment)
        if seen := oscillation(experiment):
            warning = f"pea: warning: {experiment.name}: {axis}{seen}"
            err.print(warning, highlight=False, markup=False)
    if slow := unslewed(experiment):
        err.print(f"pea: warning: {axis}{slow}", highlight=False, markup=False)


def _headline(experiment: AnyExperiment, mode: str) -> Text:
    about = experiment.about
    figure = f" (paper, {about.figure})" if about.figure else ""
    description = printable(about.description, DESCRIBED_MAX)
    return Text.assemble(
        (printable(experiment.name), "bold"),
        f": {description}{printable(figure)}\n"
        f"{mode}, {experiment.samples} samples, T_s = {experiment.T_s * 1e6:g} us"
        + (f", axes {', '.join(experiment.axes)}" if len(experiment.axes) > 1 else ""),
    )


FIRST = ("rms_error_nm", "max_error_nm", "rms_error_percent")
"""Metrics that a table begins with."""


def table(figures: dict[str, Any]) -> Table:
    """The metrics of a run."""
    value = Column("value", overflow="fold")  # a digest is compared, so it is shown whole
    told = Table("metric", value, "unit", title="metrics.json", title_justify="left")
    first = {name: figures[name] for name in FIRST if name in figures}
    for name, found in {**first, **figures}.items():
        if isinstance(found, float):
            told.add_row(name, f"{found:.6g}", unit(name))
        elif isinstance(found, int | str):
            told.add_row(name, str(found), unit(name), end_section=name == "samples_per_s")
    for name, found in figures.get("deadlines", {}).items():
        text = f"{found:.6g}" if isinstance(found, float) else str(found)
        told.add_row(name, text, unit(name))
    for name, count in figures.get("commands", {}).items():
        told.add_row("periods overrun" if name == "overruns" else f"commands {name}", str(count))
    for axis, own in figures.get("axes", {}).items():
        for name in FIRST:
            if own[name] is not None:  # of an axis that holds still, there is no percentage
                told.add_row(f"{axis}: {name}", f"{own[name]:.6g}", unit(name))
    segments = figures.get("segments", ())
    for segment in segments if len(segments) > 1 else ():
        told.add_row(
            f"rms_error_nm at {segment['frequency_hz']:g} Hz",
            f"{segment['rms_error_nm']:.6g}",
            "nm",
        )
    return told


COMMANDS: dict[str, Callable[[argparse.Namespace], int]] = {"run": _run}
