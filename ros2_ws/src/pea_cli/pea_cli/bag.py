"""Commands on recordings: ``pea replay``, ``pea bag``, ``pea diff``, ``pea export``.

Exit status: 0 the same or whole, 2 bad input (one line), 3 different or not whole.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import shutil
import tempfile
from collections.abc import Callable, Sequence
from functools import wraps
from pathlib import Path
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.table import Table

from pea_cli import play as play_cli
from pea_cli.options import number, path_of, sets
from pea_core import config
from pea_core.console import out
from pea_core.params import ParameterError, nearest
from pea_core.units import NS, SECOND
from pea_record.read import load_axes, path_and_axis, topics
from pea_record.recording import BagError, Recording

DIFFERENT = 3
"""Exit status where two runs differ, or a recording is not whole."""

NO_SUCH_PLACE = (FileNotFoundError, NotADirectoryError, IsADirectoryError, PermissionError)
"""What is raised for a file that nobody can write there."""

EXPORTS = ("csv", "parquet", "mat", "hdf5", "netcdf")
"""Formats that a recording is written to."""

Command = Callable[[argparse.Namespace], int]


def add(commands: Any) -> None:
    """Add the commands to the parser's."""
    replays = commands.add_parser("replay", help="run a recording's blocks again and compare")
    _bag(replays)
    replays.add_argument(
        "--through", default="both", help="observer, controller, both (default: both)"
    )
    replays.add_argument("--observer", metavar="TYPE", help="another observer: type or preset")
    replays.add_argument("--controller", metavar="PRESET", help="another law: preset or type")
    sets(replays)
    replays.add_argument(
        "--params", metavar="FILE", type=path_of, help="parameter file, if the bag has none"
    )
    replays.add_argument("--out", metavar="PNG", type=path_of, help="plot of the differences")
    replays.add_argument(
        "--update-golden",
        action="store_true",
        help="make BAG.mcap again from its own experiment; the only command that overwrites a bag",
    )
    play_cli.add_options(replays)
    bags = commands.add_parser("bag", help="look at recordings, repair and cut them")
    actions = bags.add_subparsers(dest="action", parser_class=type(bags))
    _bag(actions.add_parser("info", help="what is in a recording"))
    _bag(actions.add_parser("check", help="check that it is complete and replays exactly"))
    recovers = actions.add_parser("recover", help="copy the readable part into a new bag")
    cuts = actions.add_parser("cut", help="copy a part into a new bag")
    for parser in (recovers, cuts):
        _bag(parser)
        parser.add_argument("--out", metavar="DIR", type=path_of, help="the new bag")
    cuts.add_argument("--from", metavar="S", dest="start", help="loop time of the first sample")
    cuts.add_argument("--to", metavar="S", dest="end", help="loop time of the first omitted sample")
    diffs = commands.add_parser("diff", help="two recordings: parameters, metrics, divergence")
    diffs.add_argument("first", metavar="A", type=path_of, help="directory, or MCAP file")
    diffs.add_argument("second", metavar="B", type=path_of, help="directory, or MCAP file")
    diffs.add_argument("--json", action="store_true", help="as JSON")
    exports = commands.add_parser("export", help="a recording as a table in another format")
    exports.add_argument("bag", metavar="BAG", type=path_of, help="directory, or MCAP file")
    for kind in EXPORTS:
        exports.add_argument(f"--{kind}", metavar="FILE", type=path_of, help="new file")
    exports.add_argument(
        "--truth",
        action="store_true",
        help="add the true x1, x2 and eps of a simulated plant, from running it again",
    )


def _bag(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("bag", metavar="BAG", type=path_of, help="directory, or MCAP file")
    parser.add_argument("--json", action="store_true", help="as JSON")


def one_line(command: Command) -> Command:
    """Turn what a recording or an existing file says into bad input."""

    @wraps(command)
    def told(arguments: argparse.Namespace) -> int:
        try:
            return command(arguments)
        except BagError as error:
            raise ParameterError(str(error)) from None
        except FileExistsError as error:
            text = str(error) if error.filename is None else f"{error.filename} already exists"
            raise ParameterError(text) from None
        except NO_SUCH_PLACE as error:
            raise ParameterError(
                f"{error.filename}: {error.strerror}; name a file in a directory that you may write"
            ) from None

    return told


def _say(text: str) -> None:
    out.print(text, highlight=False, markup=False)


AGAIN: dict[str, Any] = {
    "through": "both",
    **dict.fromkeys(("observer", "controller", "sets", "params", "out", "update_golden")),
}
"""Options of running blocks again, as they are where nobody gives them."""


def _replay(arguments: argparse.Namespace) -> int:
    play_cli.check(arguments, AGAIN)
    if arguments.publish:
        return play_cli.publish(arguments)
    from pea_report import recorded, replay

    through = arguments.through
    if through not in replay.THROUGH:
        raise ParameterError(f"unknown --through {through!r}: {nearest(through, replay.THROUGH)}")
    others = {n: v for n in ("observer", "controller") if (v := getattr(arguments, n))}
    other = bool(replay.asked(arguments.sets, others, through))
    path: Path = arguments.bag
    recording = load_axes(path)
    experiment = recorded.axes_experiment_of(
        recording, path, arguments.sets, others, params=arguments.params, through=through
    )
    if arguments.update_golden:
        return _update_golden(path, experiment)
    axes = recording.axes
    without = {axis: replay.asked(arguments.sets, others, through, axes, axis) for axis in axes}
    each = replay.replay_axes(recording, experiment, path, through, without)
    first = replay.first_of(each)
    figures: dict[str, Any] = {
        "bag": str(path),
        "through": through,
        "samples": min(len(found.samples) for found in each.values()),
        "of": len(recording.samples),
        "changes": sum(found.changes for found in each.values()),
        "exact": first is None,
        "first": first and first[1]._asdict(),
    }
    if len(each) > 1:
        figures["first"] = first and {"axis": first[0], **first[1]._asdict()}
    if other or arguments.out:
        differences = {axis: found.differences for axis, found in each.items()}
        figures |= {"differences": config.flat(axes, list(differences.values())), "plot": None}
        there = arguments.out or _free(_folder(path) / "replay.png")
        if there.exists():
            raise ParameterError(f"--out {there}: exists already")
        replay.draw(there, each, experiment)
        figures["plot"] = str(there)
    if arguments.json:
        print(json.dumps(figures), flush=True)
    else:
        _show_replay(figures, _told(first, axes), "" if other else _version(recording))
    return 0 if other or first is None else DIFFERENT


def _told(first: Any, axes: Sequence[str]) -> str:
    """The first difference in words."""
    if first is None:
        return ""
    return f"{first[0]}: {first[1]}" if len(axes) > 1 else str(first[1])


def _folder(path: Path) -> Path:
    """Directory that a recording is in."""
    there, _ = path_and_axis(path)
    return there if there.is_dir() else there.parent


def _show_replay(figures: dict[str, Any], first: str, version: str) -> None:
    n, of = figures["samples"], figures["of"]
    part = "" if n == of else f" of {of}"
    changes = f", {figures['changes']} changes of parameters" if figures["changes"] else ""
    if figures["exact"]:
        _say(f"{n} samples{part} through {figures['through']}: the same to the bit{changes}")
    else:
        _say(f"{n} samples{part} through {figures['through']}: different{changes}")
        _say(f"first difference, recorded and replayed: {first}")
        if version:
            _say(version)
    if "differences" not in figures:
        return
    table = Table("output", "rms", "max", "unit", box=SIMPLE_HEAD, title="replayed - recorded")
    for name, row in figures["differences"].items():
        table.add_row(name, f"{row['rms']:.6g}", f"{row['max']:.6g}", row["unit"])
    out.print(table)
    _say(f"plot  {figures['plot']}")


def _version(recording: Recording) -> str:
    """A line on what differs between the recorder's software or machine and this one."""
    from pea_record import origin

    then = recording.metadata.get(origin.ORIGIN, {})
    now = origin.origin("", {}, "", 0)
    names = ("version", "commit", "python", "numpy", "machine")
    found = [f"{n} {then[n]}, now {now[n]}" for n in names if then.get(n) and then[n] != now[n]]
    return f"recorded with {'; '.join(found)}" if found else ""


def _free(path: Path) -> Path:
    """`path`, or the same with the first number that no file has."""
    found, number = path, 1
    while found.exists():
        number += 1
        found = path.with_name(f"{path.stem}-{number}{path.suffix}")
    return found


def _update_golden(path: Path, experiment: Any) -> int:
    from pea_run.modes import batch

    if not path.is_file():
        raise ParameterError(f"--update-golden: {path} is a directory: give an MCAP file")
    with tempfile.TemporaryDirectory() as there:
        batch.run(experiment, Path(there) / "golden", lambda k: None)
        (made,) = (Path(there) / "golden").glob("*.mcap")
        shutil.copyfile(made, path)
    _say(f"{path}: {experiment.samples} samples of {experiment.name}, made anew")
    return 0


def _bag_command(arguments: argparse.Namespace) -> int:
    actions = {"info": _info, "check": _check, "recover": _recover, "cut": _cut}
    if arguments.action is None:
        raise ParameterError(f"bag: give one of {', '.join(actions)} (see pea bag --help)")
    return actions[arguments.action](arguments)


def facts(recording: Recording, path: Path) -> dict[str, Any]:
    """What is in a recording, for `pea bag info`."""
    path, _ = path_and_axis(path)
    from pea_record.origin import ORIGIN, words
    from pea_record.trigger import windows

    files = [path] if path.is_file() else sorted(path.glob("*.mcap"))
    told = words(recording.metadata.get(ORIGIN, {}))
    return {
        "bag": str(path),
        "bytes": sum(file.stat().st_size for file in files),
        "axes": list(recording.axes),
        "samples": len(recording.samples),
        "sample_period_ns": recording.T_ns,
        "first_s": recording.first * NS,
        "last_s": recording.last * NS,
        "damage": recording.damage,
        "run": told,
        "changes": sum(bool(event.changed) for event in recording.events),
        "topics": topics(recording),
        "windows": [
            {"begin_s": w.begin * NS, "end_s": w.end * NS, "trigger_s": w.fired * NS}
            for w in windows(recording.metadata)
        ],
    }


def _info(arguments: argparse.Namespace) -> int:
    recording = load_axes(arguments.bag)
    figures = facts(recording, arguments.bag)
    if arguments.json:
        print(json.dumps(figures), flush=True)
        return 0
    table = Table("", "", box=None, show_header=False)
    rows = {n: v for n, v in figures.items() if n not in ("run", "topics", "damage", "windows")}
    rows["axes"] = ", ".join(rows["axes"])
    for name, value in {**rows, **figures["run"]}.items():
        table.add_row(name, f"{value:g}" if isinstance(value, float) else str(value))
    out.print(table)
    columns = ("messages", "first_ns", "last_ns", "gaps", "repeats")
    told = Table("topic", *columns, box=SIMPLE_HEAD)
    for name, topic in figures["topics"].items():
        told.add_row(name, *(str(topic.get(column, "")) for column in columns))
    out.print(told)
    for i, window in enumerate(figures["windows"]):
        _say(
            f"window {i}: {window['begin_s']:.6f} s to {window['end_s']:.6f} s, triggered at "
            f"{window['trigger_s']:.6f} s"
        )
    if figures["damage"]:
        _say(f"damage: {figures['damage']}")
    return 0


def _exactly(recording: Recording, path: Path) -> tuple[bool | None, str]:
    """Whether a recording replays to the bit, None where nothing can say so; and why not.

    Raises
    ------
    BagError, ParameterError
        What it says of its run is of another version, or contradicts it.
    """
    from pea_report import recorded, replay

    try:
        experiment = recorded.axes_experiment_of(recording, path, through="both")
    except recorded.Untold as error:  # of another recorder, or of nodes that are not ours
        return None, str(error)
    try:
        first = replay.first_of(replay.replay_axes(recording, experiment, path))
    except BagError as error:
        return None, str(error)
    if first is None:
        return True, ""
    return False, f"first difference, recorded and replayed: {_told(first, recording.axes)}"


def _check(arguments: argparse.Namespace) -> int:
    from pea_record.copy import lacks

    path = arguments.bag
    recording = load_axes(path)
    missing = lacks(recording)
    exact, why = _exactly(recording, path)
    figures = {
        "bag": str(path),
        "samples": len(recording.samples),
        "sample_period_ns": recording.T_ns,
        "complete": not missing,
        "missing": missing,
        "replays_exactly": exact,
        "why": why,
    }
    if arguments.json:
        print(json.dumps(figures), flush=True)
    else:
        _say(f"{path}: {len(recording.samples)} samples, one each {recording.T_ns} ns")
        _say("complete: " + ("yes" if not missing else "; ".join(missing)))
        _say("replays exactly: " + {True: "yes", False: f"no: {why}", None: why}[exact])
        if exact is False and (version := _version(recording)):
            _say(version)
    return DIFFERENT if missing or exact is False else 0


def _beside(path: Path, end: str) -> Path:
    """Directory beside a recording, named after it."""
    there = path.resolve()
    return there.with_name((there.stem if there.is_file() else there.name) + end)


def _all_axes(action: str, path: Path) -> None:
    """Refuse one axis where messages are copied, which hold all axes."""
    there, axis = path_and_axis(path)
    if axis:
        raise ParameterError(f"bag {action}: copies the messages of all axes; give {there}")


def _recover(arguments: argparse.Namespace) -> int:
    from pea_record.copy import recover

    _all_axes("recover", arguments.bag)
    there = arguments.out or _beside(arguments.bag, "-recovered")
    recording, missing = recover(arguments.bag, there)
    figures = {"bag": str(there), "samples": len(recording.samples), "missing": missing}
    if arguments.json:
        print(json.dumps(figures), flush=True)
        return 0
    last = recording.last * NS
    _say(f"{len(recording.samples)} samples, up to {last:.6f} s, in {there}")
    for line in missing or ["nothing is missing"]:
        _say(line)
    return 0


def _cut(arguments: argparse.Namespace) -> int:
    from pea_record.copy import cut
    from pea_record.origin import ORIGIN
    from pea_report import recorded

    if arguments.start is None and arguments.end is None:
        raise ParameterError("bag cut: give --from S, --to S, or both")
    start = round(number("--from", arguments.start or "0", 0.0, 1e9, "s") * SECOND)
    end = round(number("--to", arguments.end or "1e9", 0.0, 1e9, "s") * SECOND)
    if end <= start:
        raise ParameterError(f"--to {arguments.end}: must be after --from {arguments.start or 0}")
    path = arguments.bag
    _all_axes("cut", path)
    recording = load_axes(path)
    there = arguments.out or _beside(path, "-cut")
    told = recording.metadata.get(ORIGIN)
    if told:
        with contextlib.suppress(recorded.Untold):
            experiment = recorded.axes_experiment_of(recording, path)
            told = {**told, "parameters": recorded.text(recording, experiment, start - 1)}
    part = cut(path, there, start, end, told)
    if arguments.json:
        print(json.dumps(facts(part, there)), flush=True)
    else:
        _say(
            f"{len(part.samples)} samples, {part.first * NS:.6f} s to {part.last * NS:.6f} s, "
            f"in {there}"
        )
    return 0


def differing(first: Any, second: Any) -> dict[str, list[Any]]:
    """Entries of two mappings that are not the same; None where one lacks it."""
    return {
        name: [first.get(name), second.get(name)]
        for name in dict.fromkeys([*first, *second])
        if first.get(name) != second.get(name)
    }


def _diff(arguments: argparse.Namespace) -> int:
    from pea_core.axes import one_axis
    from pea_experiment.metrics import metrics
    from pea_report import recorded, replay
    from pea_report.true_states import true_states

    paths = (arguments.first, arguments.second)
    recordings = [load_axes(path) for path in paths]
    axes = recordings[0].axes
    if len(axes) != len(recordings[1].axes):
        told = " and ".join(f"{path}: {', '.join(r.axes)}" for path, r in zip(paths, recordings))
        raise ParameterError(f"diff: other axes ({told}): choose one with BAG@AXIS")
    values, figures = [], []
    for recording, path in zip(recordings, paths):
        experiment = recorded.axes_experiment_of(recording, path)
        sections = experiment.sections()
        values.append({f"{s}.{n}": v for s, body in sections.items() for n, v in body.items()})
        true = true_states(recording, path)
        own = []
        for i, one in enumerate(experiment.each):
            plant = one.nodes["plant"].params
            limits = (plant.voltage_min, plant.voltage_max)
            segments = one.segments_in(len(recording.samples))
            samples = one_axis(recording.samples, i)
            own_true = None if true is None else one_axis(true, i)
            own.append(metrics(samples, own_true, segments, *limits))
        figures.append(config.flat(recording.axes, own) if len(own) > 1 else own[0])
        figures[-1]["samples"] = len(recording.samples)
    a, b = (r.samples for r in recordings)
    n = min(len(a), len(b))
    by_axis = [
        (found, axis)
        for i, axis in enumerate(axes)
        if (found := replay.divergence(one_axis(a[:n], i), one_axis(b[:n], i), replay.SIGNALS))
    ]
    found, axis = min(by_axis, default=(None, ""))
    report: dict[str, Any] = {
        "parameters": differing(*values),
        "metrics": differing(*figures),
        "first": found and {**({"axis": axis} if len(axes) > 1 else {}), **found._asdict()},
    }
    if arguments.json:
        print(json.dumps(report), flush=True)
    else:
        for what in ("parameters", "metrics"):
            if report[what]:
                table = Table(what, *map(str, paths), box=SIMPLE_HEAD)
                for name, pair in report[what].items():
                    if name.rpartition(".")[2] != "segments":
                        table.add_row(name, *(_short(value) for value in pair))
                out.print(table)
            else:
                _say(f"{what}: the same")
        where = _told((axis, found), axes)
        _say(f"first difference: {where}" if found else f"{n} samples: the same to the bit")
    return DIFFERENT if found or len(a) != len(b) or report["parameters"] else 0


def _short(value: object) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _export(arguments: argparse.Namespace) -> int:
    from pea_record import frame

    asked = {n: p for n in EXPORTS if (p := getattr(arguments, n))}
    if not asked:
        raise ParameterError(f"export: give one of --{' FILE, --'.join(EXPORTS)} FILE")
    table = frame.load(arguments.bag)
    if arguments.truth:
        from pea_report.true_states import add_truth

        add_truth(table)
    for kind, path in asked.items():
        getattr(table, f"to_{kind}")(path)
        _say(f"{len(table)} samples in {path}")
    return 0


COMMANDS: dict[str, Command] = {
    "replay": one_line(_replay),
    "bag": one_line(_bag_command),
    "diff": one_line(_diff),
    "export": one_line(_export),
}
