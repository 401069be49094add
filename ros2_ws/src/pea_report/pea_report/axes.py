"""Figures of a stage of several axes: its path, and tracking and error of each axis."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pea_core.axes import one_axis
from pea_experiment.experiment import MultiAxis
from pea_lab.plot import plt, save
from pea_report.figures import Run, kept, last_error, last_tracking, legend, times, title_of

PATH_POINTS = 20_000
"""Samples of a path that are drawn at most."""


def runs(
    experiment: MultiAxis,
    figures: dict[str, Any],
    samples: np.ndarray,
    true: np.ndarray | None,
    begin: int = 0,
) -> list[Run]:
    """The run of each axis, as panels need it."""
    t = times(len(samples), experiment.T_s)
    return [
        Run(
            f"{one.axis}",
            t,
            one_axis(samples, i),
            None if true is None else one_axis(true, i),
            tuple(one.segments),
            figures["axes"][one.axis],
            begin,
        )
        for i, one in enumerate(experiment.each)
    ]


def path(axis: Axes, first: Run, second: Run) -> None:
    """Draw where two axes were, and where they should have been."""
    part = slice(max(first.span.start, second.span.start), len(first.t))
    x, y = (run.samples[part] for run in (first, second))
    shown = np.arange(len(x))
    if len(x) > PATH_POINTS:
        starts = np.arange(PATH_POINTS // 8) * len(x) // (PATH_POINTS // 8)
        shown = kept(starts, x["y"], y["y"], x["w"], y["w"])
    axis.plot(x["y"][shown] * 1e6, y["y"][shown] * 1e6, linewidth=0.8, label="measured")
    axis.plot(x["w"][shown] * 1e6, y["w"][shown] * 1e6, "--", linewidth=0.8, label="desired")
    axis.set(
        title=f"Path of {first.name} and {second.name}",
        xlabel=f"{first.name} (µm)",
        ylabel=f"{second.name} (µm)",
    )
    axis.set_aspect("equal", adjustable="datalim")


def path_figure(title: str, first: Run, second: Run) -> Figure:
    """Draw the path of two axes alone."""
    plot, axis = plt.subplots(figsize=(7, 6), layout="constrained")
    plot.suptitle(title)
    path(axis, first, second)
    axis.set_title("")
    axis.grid(True, alpha=0.3)
    legend(axis)
    return plot


def figure(name: str, each: list[Run]) -> Figure:
    """Draw the path of the first two axes, and tracking and error of each axis."""
    plot = plt.figure(figsize=(15, 3.2 * len(each)), layout="constrained")
    plot.suptitle(name)
    grid = plot.add_gridspec(len(each), 3)
    path(plot.add_subplot(grid[:, 0]), *each[:2])
    for row, run in enumerate(each):
        for column, panel in ((1, last_tracking), (2, last_error)):
            axis = plot.add_subplot(grid[row, column])
            panel(axis, [run])
            title = axis.get_title()
            axis.set_title(f"{run.name}: {title[0].lower()}{title[1:]}")
    for axis in plot.axes:
        axis.grid(True, alpha=0.3)
        legend(axis)
    return plot


def draw_axes(
    out: Path,
    experiment: MultiAxis,
    figures: dict[str, Any],
    samples: np.ndarray,
    true: np.ndarray | None,
    begin: int = 0,
) -> None:
    """Write `figure` of a run as PNG.

    Parameters
    ----------
    out : Path
        PNG to write.
    experiment : MultiAxis
    figures : dict
        The run's metrics, ``axes`` those of each axis.
    samples : (n, axes) array of `SAMPLE`
    true : (n, axes) array of `TRUTH` or None
    begin : int
        First sample after the soft start.
    """
    save(figure(title_of(experiment), runs(experiment, figures, samples, true, begin)), out)
