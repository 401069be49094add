"""A report of recordings: one HTML page that needs nothing else, and a PNG beside it.

All of it comes from the bags; what a run has left beside its bag (deadlines) is shown where it is.
"""

from __future__ import annotations

import base64
import contextlib
import datetime
import html
import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from pea_core.axes import one_axis
from pea_core.params import ParameterError
from pea_core.printable import printable
from pea_core.units import NS
from pea_experiment.experiment import Experiment
from pea_experiment.metrics import metrics, transient, unit
from pea_experiment.scoring import scoring, unsettled
from pea_lab import frequency_response
from pea_lab.plot import plt, png
from pea_record.copy import lacks
from pea_record.large import empty, pieces
from pea_record.origin import ORIGIN, words
from pea_record.read import load_axes, path_and_axis, topics
from pea_record.recording import BagError, Recording
from pea_report import axes as drawn
from pea_report import figures as report
from pea_report import recorded
from pea_report.folder import DEADLINES, METRICS, gate, soft_start
from pea_report.interactive import part_of_page
from pea_report.true_states import true_states
from pea_wire.topics import DIAGNOSTICS

CELL_MAX = 2000
"""Characters of a text that are shown at most."""

CHANGES = 100
"""Changes of parameters that are listed at most."""

STYLE = """
:root { color-scheme: light dark;
        --ink: #1b1d21; --paper: #ffffff; --line: #d5d8de; --dim: #666b75; }
@media (prefers-color-scheme: dark) {
  :root { --ink: #d8d8d8; --paper: #16181c; --line: #3a3e46; --dim: #9aa0ab; }
}
body { color: var(--ink); background: var(--paper); font: 15px/1.5 system-ui, sans-serif;
       max-width: 76rem; margin: 2rem auto; padding: 0 1rem; }
h1, h2, h3 { line-height: 1.2; } h2 { border-top: 1px solid var(--line); padding-top: 1.5rem; }
img { max-width: 100%; height: auto; }
div.wide { overflow-x: auto; }
table { border-collapse: collapse; margin: 1rem 0; font-variant-numeric: tabular-nums; }
th, td { border-bottom: 1px solid var(--line); padding: .2rem .8rem .2rem 0; text-align: left;
         vertical-align: top; overflow-wrap: anywhere; }
td:first-child { white-space: nowrap; } th { font-weight: 600; } td.differs { font-weight: 600; }
p.about, caption, .unit { color: var(--dim); } caption { text-align: left; }
"""


def escape(text: str) -> str:
    """Text of others, as the page shows it."""
    return html.escape(printable(text, CELL_MAX))


@dataclass(frozen=True)
class Entry:
    """One recording of the page.

    Attributes
    ----------
    path : Path
        Where it is.
    recording : Recording
    experiment : Experiment or None
        What ran; None where the bag does not say.
    run : report.Run
        What the panels draw.
    """

    path: Path
    recording: Recording
    experiment: Experiment | None
    run: report.Run


def entries(path: Path, name: str) -> list[Entry]:
    """Read a recording and judge each of its axes.

    Raises
    ------
    BagError, ParameterError
        It cannot be read, or what it says of its run does not go together.
    """
    recording = load_axes(path)
    axes = recording.axes
    each: Sequence[Experiment | None] = [None] * len(axes)
    true = None
    with contextlib.suppress(recorded.Untold):
        each = recorded.axes_experiment_of(recording, path).each
        true = None if recording.first else true_states(recording, path)
    found = []
    for i, (axis, experiment) in enumerate(zip(axes, each, strict=True)):
        own = None if true is None else np.ascontiguousarray(one_axis(true, i))
        told = f"{name}@{axis}" if len(axes) > 1 else name
        found.append(_entry(path, told, recording.of(axis), experiment, own))
    return found


def _entry(
    path: Path,
    name: str,
    recording: Recording,
    experiment: Experiment | None,
    true: np.ndarray | None,
) -> Entry:
    """One axis of a recording, judged."""
    samples, T_ns = recording.samples, recording.T_ns
    segments: list[Any] = []
    begin = 0
    limits = (-np.inf, np.inf)
    path = path_and_axis(path)[0]
    if experiment is not None:
        before = recording.first // experiment.T_ns
        begin = max(soft_start(gate(path, recording), experiment.T_ns) - before, 0)
        for segment in experiment.segments_in(before + len(samples)):
            if segment.end > before:
                start = max(segment.start - before, 0)
                segments.append(segment._replace(start=start, end=segment.end - before))
        plant = experiment.nodes["plant"].params
        limits = (plant.voltage_min, plant.voltage_max)
    figures: dict[str, Any] = {
        "samples": len(samples),
        "sample_period_ns": T_ns,
        "duration_s": len(samples) * T_ns * NS,
        **metrics(samples, true, segments, *limits, begin),
    }
    said, warnings = scoring(len(samples), segments, T_ns * NS, begin)
    figures |= {"scored": said, "warnings": warnings}
    if experiment is not None and not recording.first:
        x1 = samples["y"] if true is None else true["x1"]
        figures |= transient(x1, experiment.move, experiment.T_s)
        warnings += unsettled(figures, x1, experiment.move, experiment.T_s)
        if response := frequency_response.of_run(experiment, samples):
            figures |= frequency_response.figures(response, experiment.nominal)
    t = empty(len(samples))
    for part in pieces(len(samples), t, recording.stamps):
        t[part] = recording.stamps[part] * NS
    run = report.Run(name, t, samples, true, tuple(segments), figures, begin)
    return Entry(path, recording, experiment, run)


def figures_of(entries: Sequence[Entry]) -> dict[str, Any]:
    """Metrics of a recording; of several axes those of each."""
    if len(entries) == 1:
        return entries[0].run.figures
    return {"axes": {e.recording.axes[0]: e.run.figures for e in entries}}


def _short(path: Path) -> str:
    there, axis = path_and_axis(path)
    name = there.resolve().stem if there.is_file() else there.resolve().name
    return f"{name}@{axis}" if axis else name


def names(paths: Sequence[Path]) -> list[str]:
    """A short name for each bag: its own, or its path where several have the same."""
    short = [_short(path) for path in paths]
    return [s if short.count(s) == 1 else str(p) for s, p in zip(short, paths)]


def write(out: Path, entries: Sequence[Entry]) -> None:
    """Write the page to `out`, and the first figure beside it as PNG.

    Raises
    ------
    FileExistsError
        One of them already exists.
    """
    title = _title(entries)
    runs = [e.run for e in entries]
    light, dark = _twice(lambda: report.figure(title, runs))
    text = page_text(title, entries, _image(title, light, dark))
    with open(out, "x", encoding="utf-8") as page, open(out.with_suffix(".png"), "xb") as picture:
        picture.write(light)
        page.write(text)


def write_pdf(out: Path, entries: Sequence[Entry]) -> None:
    """Write every panel of the page as a PDF, a page each.

    Raises
    ------
    FileExistsError
        It is there already.
    """
    from matplotlib.backends.backend_pdf import PdfPages

    runs = [e.run for e in entries]
    with open(out, "xb") as file, PdfPages(file, metadata={"CreationDate": None}) as pages:
        for name in report.BY_NAME:
            plot = report.paper(runs, [name])
            pages.savefig(plot)
            plt.close(plot)


def summary(entries: Sequence[Entry]) -> Figure:
    """What a run leaves as ``report.png``; of several recordings, over each other."""
    first = entries[0]
    runs = [e.run for e in entries]
    experiment = first.experiment
    title = _title(entries) if experiment is None else report.title_of(experiment)
    if len({e.path for e in entries}) > 1:
        return report.figure(_title(entries), runs, report.SHORT)
    if len(entries) > 1:
        named = zip(entries, runs, strict=True)
        return drawn.figure(title, [replace(r, name=e.recording.axes[0]) for e, r in named])
    if experiment is not None and not first.recording.first:
        response = frequency_response.of_run(experiment, first.run.samples)
        if response:
            return report.response_figure(experiment, first.run.figures, response)
    return report.figure(title, runs, report.SHORT)


def _title(entries: Sequence[Entry]) -> str:
    """Names of the bags; of a single one also what it is of."""
    title = ", ".join(e.run.name for e in entries)
    experiment = entries[0].experiment if len(entries) == 1 else None
    if experiment is None or not experiment.about.description:
        return title
    return f"{title}: {experiment.about.description}"


def _twice(draw: Callable[[], Figure]) -> tuple[bytes, bytes]:
    """A figure as PNG for a light page, and for a dark one."""
    pictures = []
    for dark in (False, True):
        with report.colours(dark):
            pictures.append(png(draw()))
    return pictures[0], pictures[1]


def _image(title: str, light: bytes, dark: bytes | None = None) -> str:
    def data(png: bytes) -> str:
        return "data:image/png;base64," + base64.b64encode(png).decode()

    source = ""
    if dark is not None:
        source = f'<source media="(prefers-color-scheme: dark)" srcset="{data(dark)}">'
    return f'<picture>{source}<img alt="{escape(title)}" src="{data(light)}"></picture>\n'


def page_text(title: str, entries: Sequence[Entry], first: str) -> str:
    """HTML of the page, which begins with `first`."""
    when = datetime.datetime.now(datetime.UTC).isoformat(sep=" ", timespec="minutes")
    body = [f"<h1>{escape(title)}</h1>\n<p class=about>pea report, {escape(when)}</p>\n", first]
    body += [_path(several) for several in _together(entries)]
    body.append("<h2>Signals</h2>\n<p class=about>Drag to zoom, double click to see all.</p>\n")
    body.append(part_of_page([e.run for e in entries]))
    body.append("<h2>Metrics</h2>\n")
    body.append(_table(entries, [_flat(e.run.figures) for e in entries], units=True))
    body.append("<p class=about>" + escape(SCORED) + "</p>\n")
    for e in entries:
        body += [
            f"<p>Warning, {escape(e.run.name)}: {escape(w)}</p>\n"
            for w in e.run.figures["warnings"]
        ]
    body.append("<h2>Loop health</h2>\n" + _table(entries, [health(e) for e in entries]))
    body += [_own(e, several=len(entries) > 1) for e in entries]
    body.append("<h2>Runs</h2>\n" + _table(entries, [about(e) for e in entries]))
    body.append("<h2>Parameters</h2>\n" + _table(entries, [parameters(e) for e in entries]))
    body += [_changes(e) for e in entries]
    head = (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width">\n'
        f"<title>{escape(title)}</title>\n<style>{STYLE}</style></head>\n<body>\n"
    )
    return head + "".join(body) + "</body></html>\n"


def _together(entries: Sequence[Entry]) -> list[list[Entry]]:
    """Entries of the axes of one recording, of each that has several."""
    found: dict[Path, list[Entry]] = {}
    for e in entries:
        found.setdefault(e.path, []).append(e)
    return [each for each in found.values() if len(each) > 1]


def _path(axes: Sequence[Entry]) -> str:
    """Where the first two axes of a recording were."""
    runs = [replace(e.run, name=e.recording.axes[0]) for e in axes]
    title = f"{axes[0].path.name}: path of {runs[0].name} and {runs[1].name}"
    return _image(title, *_twice(lambda: drawn.path_figure(title, *runs[:2])))


SCORED = (
    "Errors are x1 - w over the scored samples: the last whole periods in the second half of each "
    "part of the reference that repeats itself, in the last whole round of a series; else the "
    "second half of the run; never the soft start of a rig. x1 is the true "
    "displacement where the plant was simulated, else the measured one."
)


def _own(e: Entry, several: bool) -> str:
    """Figures of one recording that no other is drawn into."""
    said = ""
    if several:
        said += _image(e.run.name, *_twice(lambda: report.figure(e.run.name, [e.run])))
    if e.experiment is not None and not e.recording.first:
        experiment = e.experiment
        response = frequency_response.of_run(experiment, e.run.samples)
        if response:
            draw = report.response_figure
            pictures = _twice(lambda: draw(experiment, e.run.figures, response))
            said += _image(f"{e.run.name}: frequency response", *pictures)
    lateness = e.path / DEADLINES
    if lateness.is_file():
        said += _image(f"{e.run.name}: lateness", lateness.read_bytes())
    return f"<h2>{escape(e.run.name)}</h2>\n{said}" if said else ""


def _flat(figures: dict[str, Any]) -> dict[str, Any]:
    """Metrics without the inner ones: those of each segment get its frequency."""
    flat = {name: value for name, value in figures.items() if not isinstance(value, list | dict)}
    segments = figures["segments"] if len(figures["segments"]) > 1 else ()
    for segment in segments:
        flat[f"rms_error_nm at {segment['frequency_hz']:g} Hz"] = segment["rms_error_nm"]
    return flat


def health(e: Entry) -> dict[str, Any]:
    """What says whether the loop, and its recording, went well."""
    recording = e.recording
    told: dict[str, Any] = {"complete": "; ".join(lacks(recording)) or "yes"}
    for name, topic in topics(recording).items():
        told[name] = f"{topic['messages']} messages"
        if name in recording.spans:
            first, last = (ns * NS for ns in recording.spans[name])
            told[name] += f", {topic['gaps']} gaps, {topic['repeats']} repeats"
            told[name] += f", {first:.6f} s to {last:.6f} s"
    told["saturated samples"] = e.run.figures["saturated_samples"]
    told |= _deadlines(e)
    for status, text in _diagnostics(e):
        told[f"{DIAGNOSTICS.name}: {status}"] = text
    return told


def _deadlines(e: Entry) -> dict[str, Any]:
    """What ``metrics.json`` beside the bag says of them."""
    file = (e.path if e.path.is_dir() else e.path.parent) / METRICS
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError, AttributeError):
        kept = json.loads(file.read_text(encoding="utf-8"))["deadlines"]
        return {f"deadlines: {name}": value for name, value in kept.items()}
    return {"deadlines": f"no {METRICS} beside the bag says; see pea: loop, if it is below"}


def _diagnostics(e: Entry) -> Iterator[tuple[str, str]]:
    """What each node has said of itself at last, and every transition of a plant's safety."""
    from pea_record.messages import diagnostics

    last: dict[str, str] = {}
    with contextlib.suppress(BagError):
        for time, status in diagnostics(e.path):
            values = ", ".join(f"{pair.key} {pair.value}" for pair in status.values)
            text = ": ".join(filter(None, (status.message, values)))
            if status.name.endswith("safety"):
                yield f"{status.name} at {time * NS:.6f} s", text
            else:
                last[status.name] = text
    yield from last.items()


def about(e: Entry) -> dict[str, Any]:
    """What ran, when, with which software, on what."""
    told = words(e.recording.metadata.get(ORIGIN, {}))
    first, last = e.recording.first * NS, e.recording.last * NS
    return {"bag": str(e.path), "loop time": f"{first:.6f} s to {last:.6f} s", **told}


def parameters(e: Entry) -> dict[str, Any]:
    """Every value that the run was started with."""
    sections = e.experiment.sections() if e.experiment is not None else {}
    return {f"{s}.{n}": value for s, values in sections.items() for n, value in values.items()}


def _changes(e: Entry) -> str:
    rows = [
        (f"{event.stamp * NS:.6f}", event.node, name, _text(value))
        for event in e.recording.events
        for name, value in event.changed.items()
    ]
    if not rows:
        return ""
    more = f" (the first {CHANGES} of {len(rows)})" if len(rows) > CHANGES else ""
    head = f"<h3>Changes of parameters: {escape(e.run.name)}{more}</h3>\n"
    return head + _rows(("loop time (s)", "node", "parameter", "value"), rows[:CHANGES])


def _table(
    entries: Sequence[Entry], columns: Sequence[dict[str, object]], units: bool = False
) -> str:
    """A row a name, a column a bag; what differs between bags is set off."""
    rows = []
    for name in dict.fromkeys(name for column in columns for name in column):
        values = [_text(column.get(name)) for column in columns]
        rows.append((name, *values, *([unit(name.split(" ")[0])] if units else [])))
    if not rows:
        return "<p>The recording does not say.</p>\n"
    head = ("", *(e.run.name for e in entries), *([""] if units else []))
    return _rows(head, rows, range(1, len(entries) + 1))


def _rows(head: Sequence[str], rows: Iterable[Sequence[str]], compared: Sequence[int] = ()) -> str:
    said = ["<div class=wide><table>\n<tr>", *(f"<th>{escape(h)}</th>" for h in head), "</tr>\n"]
    for row in rows:
        mark = " class=differs" if len({row[i] for i in compared}) > 1 else ""
        cells = (
            f"<td{mark if i in compared else ''}>{escape(text)}</td>" for i, text in enumerate(row)
        )
        said += ["<tr>", *cells, "</tr>\n"]
    return "".join((*said, "</table></div>\n"))


def _text(value: object) -> str:
    if value is None:
        return "–"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def free(directory: Path) -> Path:
    """A name in `directory` that neither page nor PNG has."""
    out, number = directory / "analysis.html", 1
    while out.exists() or out.with_suffix(".png").exists():
        number += 1
        out = out.with_name(f"analysis-{number}.html")
    return out


def check(out: Path) -> None:
    """Refuse a name that cannot be written.

    Raises
    ------
    ParameterError
        It does not end in ``.html``, there is no such directory, or a file already exists.
    """
    if out.suffix != ".html":
        raise ParameterError(f"--out {out}: must end in .html; the PNG gets the same name")
    if not out.parent.is_dir():
        raise ParameterError(f"--out {out}: there is no directory {out.parent}")
    for path in (out, out.with_suffix(".png")):
        if path.exists():
            raise ParameterError(f"--out {out}: {path} exists already; nothing is written over")
