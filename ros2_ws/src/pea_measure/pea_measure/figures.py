"""Figures of measurements; what is in SI is shown in um, nm, ms."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pea_core.printable import printable
from pea_core.units import NM_PER_M
from pea_lab.plot import TITLE_MAX, plt, save
from pea_measure.plans import PlannedMeasurement
from pea_reference.model import levels

POINTS = 20_000
"""Points that a curve over time has at most."""


def figure(
    path: Path, measurement: PlannedMeasurement, found: dict[str, object], samples: np.ndarray
) -> None:
    """Draw a measurement as PNG."""
    save(drawn(measurement, found, samples), path)


def drawn(measurement: PlannedMeasurement, found: dict[str, object], samples: np.ndarray) -> Figure:
    """The figure of a measurement."""
    plot, axes = plt.subplots(2, 2, figsize=(11, 7), constrained_layout=True)
    title = f"{measurement.experiment.name}: {measurement.announced()}"
    plot.suptitle(printable(title, TITLE_MAX), fontsize=10)
    DRAWN[measurement.kind](axes.ravel(), measurement, found, samples)
    for axis in axes.ravel():
        if not axis.has_data():
            axis.set_axis_off()
        else:
            axis.grid(True, which="both", alpha=0.25)
    return plot


def complex_of(table: dict[str, Any]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """f (Hz), response and 95 % radius of a curve in JSON."""
    G = np.array(table["real"]) + 1j * np.array(table["imag"])
    radius = np.array([np.nan if x is None else x for x in table["radius_95"]])
    return np.array(table["f_hz"]), G, radius


def bode(size: Axes, phase: Axes, curves: dict[str, Any], names: dict[str, str]) -> None:
    """Size in dB and phase of curves; measured ones with their 95 % band."""
    for name, style in names.items():
        if name not in curves:
            continue
        f, G, radius = complex_of(curves[name])
        (line,) = size.semilogx(f, 20.0 * np.log10(np.abs(G)), style, label=name, linewidth=1.0)
        if np.nanmax(radius, initial=0.0) > 0.0:
            low = np.maximum(np.abs(G) - radius, 1e-3 * np.abs(G))
            size.fill_between(
                f,
                20.0 * np.log10(low),
                20.0 * np.log10(np.abs(G) + radius),
                alpha=0.25,
                color=line.get_color(),
            )
        phase.semilogx(f, np.degrees(np.unwrap(np.angle(G))), style, linewidth=1.0)
    size.set(ylabel="size (dB)")
    size.legend(fontsize=8)
    phase.set(ylabel="phase (deg)", xlabel="frequency (Hz)")


def _quality(axis: Axes, table: dict[str, Any]) -> None:
    """Size, noise and nonlinearity of a curve."""
    f, G, _ = complex_of(table)
    axis.loglog(f, np.abs(G), label="size", linewidth=1.0)
    for name in ("noise", "nonlinear"):
        variance = table[f"{name}_variance"]
        if any(x is not None for x in variance):
            x = np.sqrt([np.nan if v is None else v for v in variance])
            axis.loglog(f, x, ".", markersize=2, label=f"{name}, standard deviation")
    axis.set(xlabel="frequency (Hz)")
    axis.legend(fontsize=8)


def _loop(
    axes: Any, measurement: PlannedMeasurement, found: dict[str, Any], samples: np.ndarray
) -> None:
    curves = found["curves"]
    names = {"S": "C0-", "T": "C1-", "L": "C2-", "T_w": "C4-", "S_plant": "k--", "S_nominal": "k:"}
    bode(axes[0], axes[2], curves, names)
    if "S" in curves:
        _quality(axes[1], curves["S"])
        axes[1].set(title="S")
        _, L, _ = complex_of(curves["L"])
        axes[3].plot(L.real, L.imag, linewidth=1.0)
        axes[3].plot([-1.0], [0.0], "k+")
        axes[3].set(xlim=(-3, 2), ylim=(-2.5, 2.5), xlabel="Re L", ylabel="Im L", aspect="equal")


def _response(
    axes: Any, measurement: PlannedMeasurement, found: dict[str, Any], samples: np.ndarray
) -> None:
    bode(axes[0], axes[2], found["curves"], {"P_m_per_V": "C0-"})
    axes[0].set(title="dB re 1 m/V")
    _quality(axes[1], found["curves"]["P_m_per_V"])
    _time(axes[3], measurement, samples)


def _time(axis: Axes, measurement: PlannedMeasurement, samples: np.ndarray) -> None:
    """w and y over time."""
    every = max(len(samples) // POINTS, 1)
    t = np.arange(len(samples))[::every] * measurement.experiment.T_s
    axis.plot(t, samples["w"][::every] * 1e6, linewidth=0.8, label="w")
    axis.plot(t, samples["y"][::every] * 1e6, linewidth=0.8, label="y")
    axis.set(xlabel="time (s)", ylabel="displacement (µm)")
    axis.legend(fontsize=8)


def _steps(
    axes: Any, measurement: PlannedMeasurement, found: dict[str, object], samples: np.ndarray
) -> None:
    _time(axes[0], measurement, samples)
    T_s = measurement.experiment.T_s
    first, _, end = levels.times(measurement.experiment.nodes["reference"].params, T_s)
    for index, size in measurement.settings["steps"]:
        k = int(first[index])
        stop = int(first[index + 1]) if index + 1 < len(first) else end
        y, w = samples["y"][k:stop], samples["w"][stop - 1]
        before = samples["w"][max(k - 1, 0)]
        share = (y - before) / (w - before)
        axis = axes[1] if size > 0.0 else axes[3]
        axis.plot(np.arange(len(y)) * T_s * 1e3, share, linewidth=0.7)
        axis.set(xlabel="time (ms)", ylabel="share of the step")
    axes[2].plot(samples["u"], linewidth=0.6)
    axes[2].set(xlabel="sample", ylabel="command (V)")


def _hysteresis(
    axes: Any, measurement: PlannedMeasurement, found: dict[str, object], samples: np.ndarray
) -> None:
    u, y = samples["u_applied"], samples["y"] * 1e6
    every = max(len(u) // POINTS, 1)
    axes[0].plot(u[::every], y[::every], linewidth=0.7)
    axes[0].set(xlabel="voltage (V)", ylabel="displacement (µm)")
    line = np.polyfit(u, y, 1)
    axes[1].plot(u[::every], (y - np.polyval(line, u))[::every], linewidth=0.7)
    axes[1].set(xlabel="voltage (V)", ylabel="off the line (µm)")
    _time(axes[2], measurement, samples)


def _creep(
    axes: Any, measurement: PlannedMeasurement, found: dict[str, object], samples: np.ndarray
) -> None:
    _time(axes[0], measurement, samples)
    T_s = measurement.experiment.T_s
    first, there, end = levels.times(measurement.experiment.nodes["reference"].params, T_s)
    index = measurement.settings["step"]
    stop = int(first[index + 1]) if index + 1 < len(first) else end
    y = samples["y"][int(there[index]) : stop] * 1e6
    grid = np.unique(np.geomspace(1, len(y) - 1, 2000).astype(int))
    axes[1].semilogx(grid * T_s, y[grid], linewidth=0.8)
    axes[1].set(xlabel="time since the step (s)", ylabel="displacement (µm)")


def _noise(
    axes: Any, measurement: PlannedMeasurement, found: dict[str, Any], samples: np.ndarray
) -> None:
    curves = found["curves"]
    axes[0].loglog(curves["f_hz"], curves["density_nm_per_rtHz"], linewidth=0.8)
    axes[0].set(xlabel="frequency (Hz)", ylabel="density (nm/sqrt(Hz))")
    axes[1].semilogx(curves["f_hz"], curves["cumulative_nm"], linewidth=0.8)
    axes[1].set(xlabel="frequency (Hz)", ylabel="cumulative rms (nm)")
    axes[2].loglog(curves["tau_s"], curves["allan_nm"], ".-", linewidth=0.8)
    axes[2].set(xlabel="averaging time (s)", ylabel="Allan deviation (nm)")
    _time(axes[3], measurement, samples)


def _positions(
    axes: Any, measurement: PlannedMeasurement, found: dict[str, Any], samples: np.ndarray
) -> None:
    rows = found["positions"]
    x = [row["position_um"] for row in rows]
    for side, mark in (("up", "^-"), ("down", "v-")):
        axes[0].errorbar(
            x,
            [row[f"error_{side}_nm"] for row in rows],
            yerr=[2.0 * (row[f"s_{side}_nm"] or 0.0) for row in rows],
            fmt=mark,
            label=f"from {'below' if side == 'up' else 'above'}, 2 s",
        )
    axes[0].set(xlabel="position (µm)", ylabel="error (nm)")
    axes[0].legend(fontsize=8)
    _time(axes[1], measurement, samples)


def _increments(
    axes: Any, measurement: PlannedMeasurement, found: dict[str, object], samples: np.ndarray
) -> None:
    T_s = measurement.experiment.T_s
    first, _, end = levels.times(measurement.experiment.nodes["reference"].params, T_s)
    smallest = found["smallest_increment_nm"] or measurement.settings["stairs"][-1][0]
    for increment, indices in measurement.settings["stairs"]:
        if increment == smallest:
            stop = int(first[indices[-1] + 1]) if indices[-1] + 1 < len(first) else end
            part = slice(int(first[indices[0]]), stop)
            base = samples["w"][part][0]
            t = np.arange(stop - part.start) * T_s
            for name in ("y", "w"):
                axes[0].plot(t, (samples[name][part] - base) * NM_PER_M, linewidth=0.7, label=name)
            axes[0].set(xlabel="time (s)", ylabel="nm", title=f"steps of {increment:g} nm")
            axes[0].legend(fontsize=8)


DRAWN = {
    "repeatability": _positions,
    "increments": _increments,
    "loop": _loop,
    "response": _response,
    "steps": _steps,
    "hysteresis": _hysteresis,
    "creep": _creep,
    "noise": _noise,
}
