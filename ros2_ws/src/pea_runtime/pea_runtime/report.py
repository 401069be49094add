"""Figures of a run: ``report.png``."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from PIL import Image

from pea_runtime import frequency_response
from pea_runtime.experiments import Experiment
from pea_runtime.frequency_response import Response
from pea_runtime.metrics import scored

POINTS = 20_000
"""Points a curve is drawn with at most; where there are more, minima and maxima are kept."""


def thin(t: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """At most `POINTS` points that keep every piece's minimum and maximum."""
    if len(x) <= POINTS:
        return t, x
    pieces = np.array_split(np.arange(len(x)), POINTS // 2)
    keep = np.unique([i for p in pieces for i in (p[x[p].argmin()], p[x[p].argmax()])])
    return t[keep], x[keep]


def save(plot: Figure, path: Path) -> None:
    """Write a figure as PNG of few colours, a third of the size."""
    pixels = io.BytesIO()
    plot.savefig(pixels, dpi=90)
    plt.close(plot)
    Image.open(pixels).convert("RGB").quantize(64).save(path, optimize=True)


def _title(experiment: Experiment) -> str:
    about = experiment.about
    title = f"{experiment.name}: {about.description}"
    return title + (f" (paper, {about.figure})" if about.figure else "")


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
    plot.suptitle(_title(experiment))
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
    for number, (segment, part) in enumerate(scored(len(t), experiment.segments).items()):
        label = None if number else "scored"
        errors.axvspan(t[part.start], t[part.stop - 1], color="tab:green", alpha=0.08, label=label)
        if segment and len(figures["segments"]) > 1:
            rms = figures["segments"][number]["rms_error_nm"]
            text = f"{segment.frequency_hz:g} Hz\n{rms:.3g}"
            errors.text(
                t[(part.start + part.stop) // 2],
                0.97,
                text,
                transform=errors.get_xaxis_transform(),
                ha="center",
                va="top",
                fontsize="x-small",
            )
    largest = 1.5 * float(np.abs(error[start:]).max()) or 1.0
    errors.set(
        title=f"Tracking error, rms {figures['rms_error_nm']:.4g} nm over the scored part",
        xlabel="time (s)",
        ylabel="error x1 - w (nm)",
        ylim=(-largest, largest),
    )
    errors.legend(loc="lower right")

    loop.plot(samples["u_applied"][start:], samples["y"][start:] * 1e6, linewidth=0.8)
    loop.set(
        title="Hysteresis loop, scored part",
        xlabel="applied voltage (V)",
        ylabel="displacement y (um)",
    )
    for axis in axes.flat:
        axis.grid(True, alpha=0.3)
    save(plot, path)


def draw_response(
    path: Path, experiment: Experiment, figures: dict[str, Any], response: Response
) -> None:
    """Draw gain and phase of a measured frequency response over the model's.

    Parameters
    ----------
    path : Path
        PNG to write.
    experiment : Experiment
    figures : dict
        The run's metrics.
    response : Response
        From `frequency_response.of_run`.
    """
    f = np.geomspace(response.f[0], response.f[-1], 500)
    model = frequency_response.model(experiment.nominal, f)
    held = model * frequency_response.hold(f, experiment.T_s)
    at_lines = frequency_response.model(experiment.nominal, response.f)
    plot, axes = plt.subplots(2, 2, figsize=(12, 8), constrained_layout=True, sharex=True)
    plot.suptitle(_title(experiment))

    def decibels(V: np.ndarray) -> np.ndarray:
        return 20.0 * np.log10(np.abs(V) * 1e6)

    def degrees(V: np.ndarray) -> np.ndarray:
        return np.degrees(np.unwrap(np.angle(V)))

    for axis, of, mark, found, title in (
        (axes[0, 0], decibels, "-3 dB", figures["minus_3_dB_hz"], "Gain (dB of 1 um/V)"),
        (axes[1, 0], degrees, "-90 deg", figures["minus_90_degrees_hz"], "Phase (deg)"),
    ):
        axis.semilogx(f, of(model), label="model, Eq 2")
        axis.semilogx(f, of(held), ":", label="model with the hold of a sample")
        axis.semilogx(response.f, of(response.V), "o", markersize=4, label="measured")
        if found is not None:
            axis.axvline(found, color="tab:red", linewidth=0.8, label=f"{mark} at {found:.1f} Hz")
        axis.set(title=title)
        axis.legend(loc="lower left")
    ratio = response.V / at_lines
    for axis, values, title in (
        (axes[0, 1], 20.0 * np.log10(np.abs(ratio)), "Measured against model, gain (dB)"),
        (axes[1, 1], np.degrees(np.angle(ratio)), "Measured against model, phase (deg)"),
    ):
        axis.semilogx(response.f, values, "o-", markersize=4, linewidth=0.8)
        axis.set(title=title)
    for axis in axes.flat:
        axis.grid(True, alpha=0.3)
    for axis in axes[1]:
        axis.set(xlabel="frequency (Hz)")
    save(plot, path)
