"""``docs/performance.md``: the kept figures as tables and plots."""

from __future__ import annotations

import datetime
import importlib.metadata
import os
import platform
from pathlib import Path
from typing import Any

import numpy as np

from pea_bench.plan import ROOT
from pea_bench.rows import Part, Row, kept

DOCS = ROOT / "docs"
KEPT = DOCS / "performance.json"
PAGE = DOCS / "performance.md"
FIGURES = DOCS / "performance"

LIBRARIES = ("numpy", "numba", "mcap", "ros-rclpy", "ros-fastrtps")

HEAD = """\
# Performance

Written by `make bench BENCH=--write-docs`. Every ratio is of figures from one run, round by round;
absolute figures drift by a factor of two between hours on a shared machine. The yardsticks and why:
[0012](decisions/0012-the-bench-and-its-yardsticks.md).

"""

ABOUT = {
    "batch": """\
Microseconds a sample, results in memory, in each round the best of three. The loop is that of Fig 9
with an extended-state observer instead of the true states: Bouc-Wen hysteresis, observer, PIDSMC,
sine. opensmc runs the nearest job it can: its simulator (RK4) with a PID sliding surface, no
observer, no hysteresis. A sweep has another gain K for every plant; their design is included.""",
    "composed": """\
20 kHz in wall time, recorded, with parameters, diagnostics and topics beside it. The empty loop
keeps time likewise and does nothing else; the two run in turn. The Python loop with an executor in
another thread computes nothing at all. A virtual machine is halted by its host in bursts, in some
rounds of any loop: the figures are medians of the rounds, and what all rounds together have missed
stands below.""",
    "distributed": """\
Samples a second of four processes in lock-step, start and end left out, recorded by a fifth. The
naive ring is three processes, each with a SingleThreadedExecutor, JointState objects, reliable,
depth 10; it computes and records nothing. The fast ring is the same three by the nodes' fast way:
what our fast nodes lack to it is what the blocks and the recording cost.""",
    "recorder": """\
Four topics of JointState into compressed, indexed MCAP, from numbers to the closed file. The naive
path makes an object, serialises it, adds it. What was written is read back by another reader.""",
    "memory": """\
A run of composed mode in wall time, recorded, looked at each second: medians of its second and its
last tenth. It grows while buffers fill, for some five minutes, and stays then.""",
    "hardware": """\
Loops in wall time on devices that are processes here, recorded. 20 kHz with a compiled driver,
beside an empty loop that makes the same exchange with the output held; the loop has the first
core, the device the last. The board over UDP sets the pace, so its exchange has the wait for the
next sample in it; the registers in memory go by our clock. Then four nodes over the graph on the
emulated E-727 at 1 and 2 kHz, beside the loop in one process on the same device. Missed counts
what was left out after a halt, too.""",
    "axes": """\
The same loop for two axes and more, beside one axis, in turn: a step in batch, deadlines missed in
wall time with everything recorded, and four nodes in lock-step.""",
    "startup": """\
Wall time of the command, Python's own start included; what is compiled once was compiled.""",
}


def number(value: float | None) -> str:
    """A figure with three digits."""
    if value is None:
        return "–"
    if value and abs(value) < 1e-3:
        return f"{value:.2g}"
    return f"{value:,.0f}".replace(",", " ") if abs(value) >= 1000 else f"{value:.3g}"


def spread(row: Row) -> str:
    """Least and largest of several rounds."""
    if len(row.values) < 2 or row.spread is None:
        return ""
    return " to ".join(map(number, row.spread))


def machine() -> dict[str, str]:
    """What the figures were measured on, and with."""
    cpu = next(
        (
            line.partition(":")[2].strip()
            for line in Path("/proc/cpuinfo").read_text(errors="replace").splitlines()
            if line.startswith("model name")
        ),
        platform.machine(),
    )
    found = {
        "date": datetime.date.today().isoformat(),
        "processor": f"{cpu}, {len(os.sched_getaffinity(0))} cores",
        "load": f"{os.getloadavg()[2]:.1f} on average over 15 minutes, the bench's own included",
        "system": platform.platform(),
        "python": platform.python_version(),
    }
    for name in LIBRARIES:
        try:
            found[name.removeprefix("ros-")] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


def table(rows: list[Row]) -> str:
    """Rows as a Markdown table."""
    lines = ["| | | figure | rounds from, to | asked | |", "|---|---|---|---|---|---|"]
    for row in rows:
        mark = {True: "yes", False: "**no**", None: ""}[row.fine]
        value = f"{number(row.value)} {row.unit}".rstrip()
        name = row.name.partition(".")[2]
        asked = row.demand.replace("<=", "≤").replace(">=", "≥")
        lines.append(f"| `{name}` | {row.what} | {value} | {spread(row)} | {asked} | {mark} |")
    return "\n".join(lines) + "\n"


def text(parts: dict[str, Part], on: dict[str, str], plots: list[tuple[str, str]]) -> str:
    """The page.

    Parameters
    ----------
    parts : dict of str to Part
        What was measured.
    on : dict of str to str
        The machine.
    plots : list of (str, str)
        File and caption of each figure.
    """
    said = HEAD
    said += "| machine | |\n|---|---|\n"
    said += "".join(f"| {name} | {value} |\n" for name, value in on.items())
    for name in ABOUT:
        if name in parts:
            said += f"\n## {name.capitalize()}\n\n{ABOUT[name]}\n\n{table(parts[name].rows)}"
            said += "".join(f"\n{note}\n" for note in parts[name].notes)
    if plots:
        said += "\n## Plots\n\n"
        said += "".join(f"![{caption}]({file})\n\n{caption}\n\n" for file, caption in plots)
    return said


def write() -> None:
    """Write the page and its plots from what is kept."""
    import json

    parts = kept(KEPT)
    on = json.loads(KEPT.read_text(encoding="utf-8"))["machine"]
    FIGURES.mkdir(exist_ok=True)
    plots = draw(parts, FIGURES)
    told = [(f"{FIGURES.name}/{file}", caption) for file, caption in plots]
    PAGE.write_text(text(parts, on, told), encoding="utf-8")


def draw(parts: dict[str, Part], there: Path) -> list[tuple[str, str]]:
    """Draw what the parts have found: file and caption of each plot."""
    plots = []
    ratios = [row for part in parts.values() for row in part.rows if row.compared and row.value]
    if ratios:
        _ratios(ratios, there / "ratios.svg")
        plots.append(("ratios.svg", "Each ratio (bar) and what was asked (mark)."))
    lateness = parts["composed"].curves.get("lateness") if "composed" in parts else None
    if lateness:
        _lateness(lateness, there / "lateness.svg")
        plots.append(("lateness.svg", "Share of samples later than a time, at 20 kHz."))
    if "batch" in parts and "distributed" in parts:
        curves = parts["batch"].curves | parts["distributed"].curves
        _growth(curves, there / "growth.svg")
        plots.append(
            (
                "growth.svg",
                "Time of a recorded batch run over its duration; of a plant's sample over the "
                "number of plants in a sweep; rate of each axis over the number of axes, each a "
                "distributed loop with nodes, recorder and ROS domain of its own, on one core.",
            )
        )
    if "memory" in parts:
        _memory(parts["memory"].curves["memory"], there / "memory.svg")
        plots.append(("memory.svg", "Resident memory of `pea run` at 20 kHz in wall time."))
    return plots


def _plot(title: str, width: int = 1) -> tuple[Any, Any]:
    from pea_lab.plot import plt

    plot, axes = plt.subplots(1, width, figsize=(5 + 4 * width, 4), constrained_layout=True)
    plot.suptitle(title)
    for axis in np.atleast_1d(axes):
        axis.grid(True, alpha=0.3)
    return plot, axes


def _save(plot: Any, path: Path) -> None:
    from pea_lab.plot import save_as

    path.unlink(missing_ok=True)
    save_as(plot, path)


def _ratios(rows: list[Row], path: Path) -> None:
    plot, axis = _plot("Ratios within one run")
    places = np.arange(len(rows))[::-1]
    fine = ["tab:green" if row.fine else "tab:orange" for row in rows]
    axis.barh(places, [row.value for row in rows], color=fine)
    asked = [float(row.demand.split()[1]) for row in rows]
    axis.scatter(asked, places, marker="|", s=300, color="black", label="asked", zorder=3)
    axis.set(xscale="log", xlabel="ratio")
    axis.set_yticks(places, [f"{row.name} {row.demand[:2]}" for row in rows])
    axis.legend()
    _save(plot, path)


def _lateness(tails: dict[str, list[tuple[float, float]]], path: Path) -> None:
    plot, axis = _plot("Lateness")
    for name, tail in tails.items():
        us, later = np.array(tail).T
        axis.step(np.maximum(us, 0.1), np.maximum(later, 1e-7), where="post", label=name)
    axis.axvline(50.0, color="tab:red", linewidth=0.8, label="T_s")
    axis.set(xscale="log", yscale="log", xlabel="lateness (us)", ylabel="share of samples later")
    axis.legend()
    _save(plot, path)


def _growth(curves: dict[str, object], path: Path) -> None:
    plot, (duration, plants, axes) = _plot("Growth", 3)
    duration.loglog(*np.array(curves["duration"]).T, marker="o")
    duration.set(xlabel="loop time (s)", ylabel="batch mode with recording (s)")
    plants.loglog(*np.array(curves["plants"]).T, marker="o")
    plants.set(xlabel="plants in one sweep", ylabel="us a plant's sample")
    axes.loglog(*np.array(curves["axes"]).T, marker="o")
    axes.set(xlabel="axes", ylabel="samples a second of each axis")
    _save(plot, path)


def _memory(watched: list[tuple[float, float]], path: Path) -> None:
    plot, axis = _plot("Memory")
    axis.plot(*np.array(watched).T)
    axis.set(xlabel="time (s)", ylabel="resident (MiB)", ylim=(0, None))
    _save(plot, path)
