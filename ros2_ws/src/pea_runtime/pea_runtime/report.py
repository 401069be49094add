"""Figures of a run: ``report.png``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from pea_runtime.experiments import Experiment

POINTS = 20_000
"""Points a curve is drawn with at most; where there are more, minima and maxima are kept."""


def thin(t: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """At most `POINTS` points that keep every piece's minimum and maximum."""
    if len(x) <= POINTS:
        return t, x
    pieces = np.array_split(np.arange(len(x)), POINTS // 2)
    keep = np.unique([i for p in pieces for i in (p[x[p].argmin()], p[x[p].argmax()])])
    return t[keep], x[keep]


def draw(
    path: Path,
    experiment: Experiment,
    figures: dict[str, Any],
    samples: np.ndarray,
    true: np.ndarray | None,
) -> None:
    """Draw tracking, error, voltage and hysteresis loop.

    Parameters
    ----------
    path : Path
        PNG to write.
    experiment : Experiment
    figures : dict
        The run's metrics.
    samples : (n,) array of `SAMPLE`
    true : (n,) array of `TRUTH` or None
    """
    t = np.arange(len(samples)) * experiment.T_s
    x1 = samples["y"] if true is None else true["x1"]
    error = (x1 - samples["w"]) * 1e9
    start = figures["scored_from_sample"]
    plot, axes = plt.subplots(2, 2, figsize=(12, 8), constrained_layout=True)
    about = experiment.about
    title = f"{experiment.name}: {about.description}"
    plot.suptitle(title + (f" (paper, {about.figure})" if about.figure else ""))
    tracking, voltage, errors, loop = axes.flat

    tracking.plot(*thin(t, samples["y"] * 1e6), label="displacement y")
    tracking.plot(*thin(t, samples["w"] * 1e6), "--", label="desired w")
    tracking.set(title="Tracking", xlabel="time (s)", ylabel="displacement (um)")
    tracking.legend(loc="upper right")

    voltage.plot(*thin(t, samples["u"]), label="command u")
    voltage.plot(*thin(t, samples["u_applied"]), "--", label="applied")
    voltage.set(title="Voltage", xlabel="time (s)", ylabel="voltage (V)")
    voltage.legend(loc="upper right")

    errors.plot(*thin(t, error), linewidth=0.8)
    errors.axvspan(t[start], t[-1], color="tab:green", alpha=0.08, label="scored")
    largest = 1.5 * float(np.abs(error[start:]).max()) or 1.0
    errors.set(
        title=f"Tracking error, rms {figures['rms_error_nm']:.4g} nm over the scored part",
        xlabel="time (s)",
        ylabel="error x1 - w (nm)",
        ylim=(-largest, largest),
    )
    errors.legend(loc="upper right")

    loop.plot(samples["u_applied"][start:], samples["y"][start:] * 1e6, linewidth=0.8)
    loop.set(
        title="Hysteresis loop, scored part",
        xlabel="applied voltage (V)",
        ylabel="displacement y (um)",
    )
    for axis in axes.flat:
        axis.grid(True, alpha=0.3)
    plot.savefig(path, dpi=100)
    plt.close(plot)
