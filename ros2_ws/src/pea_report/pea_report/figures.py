"""Figures of runs: ``report.png``, and what `pea_report.report` shows.

Each panel is a function that draws runs on an axis, one or several over each other.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pea_core.printable import printable
from pea_core.units import NM_PER_M, SECOND
from pea_experiment.experiment import AnyExperiment, Experiment
from pea_experiment.metrics import Spread
from pea_experiment.scoring import Segment, scored
from pea_lab import frequency_response
from pea_lab.frequency_response import Response
from pea_lab.plot import LABEL_MAX, TITLE_MAX, plt, save
from pea_record import large
from pea_record.large import empty, give_back, pieces

POINTS = 20_000
"""Points a curve is drawn with at most; where there are more, minima and maxima are kept."""

LINE = 8_000
"""The same of a line over time: many to each pixel."""

FILE_LINE = 2_000
"""The same in a file of `pea figure`: small as vectors, and still several to each pixel."""

LONG = 1 << 22
"""Samples of an error from which on its spectrum is the mean of several."""

DECADES = 1e-6
"""Share of a spectrum's largest line below which it is not told."""

BINS = 120
"""Bins of a histogram."""

LEGEND_WIDTH, LEGEND_MARK = 72, 9
"""Letters that fit beside each other over a panel, and those that the mark of a curve takes."""

LEGEND_LINE, PANEL = 0.18, 2.7
"""Heights (in) of a line of a legend, and of a panel."""

INK, PAPER = "#d8d8d8", "#16181c"
DARK: Any = {
    **dict.fromkeys(("figure.facecolor", "axes.facecolor", "legend.facecolor"), PAPER),
    **dict.fromkeys(
        ("text.color", "axes.labelcolor", "axes.edgecolor", "xtick.color", "ytick.color"), INK
    ),
}
"""Colours of a figure on a dark page."""


@dataclass(frozen=True)
class Run:
    """A run as the panels need it.

    Attributes
    ----------
    name : str
        Its name where several are drawn.
    t : (n,) array
        Loop time (s).
    samples : (n,) array of `SAMPLE`
    true : (n,) array of `TRUTH` or None
    segments : tuple of Segment
        Parts of the reference that repeat themselves.
    figures : dict
        Its metrics.
    begin : int
        First sample after the soft start.
    points : int
        Points a line over time is drawn with at most.
    """

    name: str
    t: np.ndarray
    samples: np.ndarray
    true: np.ndarray | None
    segments: tuple[Segment, ...]
    figures: dict[str, Any]
    begin: int = 0
    points: int = LINE

    def error(self, part: slice) -> np.ndarray:
        """Tracking error x1 - w, of the true displacement where it is known (nm)."""
        x1 = self.samples["y"] if self.true is None else self.true["x1"]
        error: np.ndarray = (x1[part] - self.samples["w"][part]) * NM_PER_M
        return error

    def signal(self, name: str, scale: float = 1.0) -> Callable[[slice], np.ndarray]:
        """A recorded signal of some samples, in other units."""
        return lambda part: self.samples[name][part] * scale

    def pieces(self, part: slice) -> Iterator[slice]:
        """Some samples, so many at a time as are looked at together."""
        arrays = (self.t, self.samples, *(() if self.true is None else (self.true,)))
        for piece in pieces(part.stop - part.start, *arrays):
            yield slice(part.start + piece.start, part.start + piece.stop)

    @property
    def whole(self) -> slice:
        """All samples."""
        return slice(0, len(self.t))

    @property
    def parts(self) -> dict[Segment | None, slice]:
        """Samples over which it is scored."""
        return scored(len(self.t), self.segments, self.begin)

    @property
    def end(self) -> slice:
        """The last two scored periods, or its last twentieth where nothing repeats itself."""
        segment = next((s for s in reversed(self.parts) if s is not None), None)
        n = len(self.t)
        stop = n if segment is None else min(n, self.parts[segment].stop)
        length = n / 20 if segment is None else 2 * segment.period
        return slice(max(stop - max(round(length), 2), 0), stop)

    @property
    def span(self) -> slice:
        """All samples from the first that is scored to the last."""
        parts = self.parts.values()
        return slice(min(p.start for p in parts), max(p.stop for p in parts))


def kept(starts: np.ndarray, *columns: np.ndarray) -> np.ndarray:
    """Indices at which a column is smallest or largest in its piece; pieces begin at `starts`."""
    n = len(columns[0])
    length = np.diff(starts, append=n)
    found = []
    for x in columns:
        for extreme in (np.minimum, np.maximum):
            hits = np.flatnonzero(x == np.repeat(extreme.reduceat(x, starts), length))
            first = np.searchsorted(hits, starts)
            found.append(hits[first[first < len(hits)]])
    return np.unique(np.concatenate(found))


def even(n: int, pieces: int) -> np.ndarray:
    """Where pieces of one length begin."""
    return np.arange(pieces) * n // pieces


def thin(t: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """At most `LINE` points that keep every piece's minimum and maximum."""
    if len(x) <= LINE:
        return t, x
    keep = kept(even(len(x), LINE // 2), x)
    return t[keep], x[keep]


def line(
    run: Run, of: Callable[[slice], np.ndarray], part: slice | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """The same of a signal over time that is computed a few samples at a time."""
    part = run.whole if part is None else part
    if part.stop - part.start <= run.points:
        return run.t[part], of(part)
    t, x = _thinned(run, part, run.points // 2, (of,))
    return t, x


def curve(
    run: Run, x: Callable[[slice], np.ndarray], y: Callable[[slice], np.ndarray], part: slice
) -> tuple[np.ndarray, np.ndarray]:
    """At most `POINTS` of a curve through a plane: every piece's extremes of both."""
    if part.stop - part.start <= POINTS:
        return x(part), y(part)
    _, found_x, found_y = _thinned(run, part, POINTS // 4, (x, y))
    return found_x, found_y


def _thinned(
    run: Run, part: slice, number: int, of: Sequence[Callable[[slice], np.ndarray]]
) -> tuple[np.ndarray, ...]:
    """Time, and each signal, at the extremes of so many pieces; some pieces at a time."""
    starts = part.start + even(part.stop - part.start, number)
    together = max(large.PIECE * number // (part.stop - part.start), 1)
    found = []
    for i in range(0, number, together):
        end = int(starts[i + together]) if i + together < number else part.stop
        some = slice(int(starts[i]), end)
        signals = [each(some) for each in of]
        keep = kept(starts[i : i + together] - some.start, *signals)
        found.append((run.t[some][keep], *(signal[keep] for signal in signals)))
        for array in (run.t, run.samples, run.true):
            if array is not None:
                give_back(array)
    return tuple(np.concatenate(columns) for columns in zip(*found, strict=True))


def thin_log(f: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same over a logarithmic axis: pieces grow with f."""
    if len(x) <= POINTS:
        return f, x
    edges = np.unique(np.geomspace(1, len(x), POINTS // 2).astype(int))[:-1]
    keep = kept(np.concatenate([[0], edges]), x)
    return f[keep], x[keep]


@contextlib.contextmanager
def colours(dark: bool) -> Iterator[None]:
    """Draw for a light page, or for a dark one."""
    with plt.rc_context(DARK if dark else None):
        yield


def title_of(experiment: AnyExperiment) -> str:
    """Title of a run's figure."""
    about = experiment.about
    title = f"{experiment.name}: {about.description}"
    return printable(title + (f" (paper, {about.figure})" if about.figure else ""), TITLE_MAX)


def _named(what: str, run: Run, runs: Sequence[Run]) -> str:
    """Label of a curve."""
    name = printable(run.name, LABEL_MAX)
    return what if len(runs) == 1 else f"{name}: {what}" if what else name


def legend(axis: Axes) -> int:
    """Put the names of curves between a panel and its title, where no data is.

    Returns the number of lines that they take.
    """
    _, labels = axis.get_legend_handles_labels()
    if not labels:
        return 0
    width = max(map(len, labels)) + LEGEND_MARK
    columns = max(LEGEND_WIDTH // width, 1)
    lines = -(-len(labels) // columns)
    axis.legend(
        loc="lower left",
        bbox_to_anchor=(0.0, 1.0),
        ncols=columns,
        fontsize="small",
        frameon=False,
        borderaxespad=0.1,
        borderpad=0.1,
    )
    axis.set_title(axis.get_title(), pad=6.0 + 72.0 * LEGEND_LINE * lines)
    return lines


def tracking(axis: Axes, runs: Sequence[Run]) -> None:
    """Draw y and w over time."""
    for run in runs:
        y, w = run.signal("y", 1e6), run.signal("w", 1e6)
        axis.plot(*line(run, y), label=_named("displacement y", run, runs))
        axis.plot(*line(run, w), "--", label=_named("desired w", run, runs))
    axis.set(title="Tracking", xlabel="time (s)", ylabel="displacement (µm)")


def last_tracking(axis: Axes, runs: Sequence[Run]) -> None:
    """Draw y and w at the end of the scored part."""
    tracking(axis, [_part(run, run.end) for run in runs])
    axis.set(title="Tracking at the end of the scored part")


def last_error(axis: Axes, runs: Sequence[Run]) -> None:
    """Draw the error at the end of the scored part."""
    for run in runs:
        axis.plot(*line(run, run.error, run.end), linewidth=0.8, label=_named("", run, runs))
    axis.set(
        title="Tracking error at the end of the scored part",
        xlabel="time (s)",
        ylabel="error x1 - w (nm)",
    )


def _part(run: Run, part: slice) -> Run:
    """Some samples of a run, for a closer look."""
    true = None if run.true is None else run.true[part]
    return replace(run, t=run.t[part], samples=run.samples[part], true=true)


def voltage(axis: Axes, runs: Sequence[Run]) -> None:
    """Draw command and applied voltage over time."""
    for run in runs:
        u, applied = run.signal("u"), run.signal("u_applied")
        axis.plot(*line(run, u), label=_named("command u", run, runs))
        axis.plot(*line(run, applied), "--", label=_named("applied", run, runs))
    axis.set(title="Voltage", xlabel="time (s)", ylabel="voltage (V)")


def errors(axis: Axes, runs: Sequence[Run]) -> None:
    """Draw the tracking error over time, and what of it is scored."""
    largest = 0.0
    for run in runs:
        axis.plot(*line(run, run.error), linewidth=0.8, label=_named("", run, runs) or None)
        scored_on = slice(run.span.start, len(run.t))
        for part in run.pieces(scored_on):
            largest = max(largest, 1.5 * float(np.abs(run.error(part)).max()))
    title = "Tracking error"
    if len(runs) == 1:
        _scored(axis, runs[0])
        title += f", rms {runs[0].figures['rms_error_nm']:.4g} nm over the scored part"
    largest = largest or 1.0
    axis.set(title=title, xlabel="time (s)", ylabel="error x1 - w (nm)", ylim=(-largest, largest))


def _scored(axis: Axes, run: Run) -> None:
    """Mark what is scored, and how each sine of a series is."""
    t = run.t
    for number, (segment, part) in enumerate(run.parts.items()):
        label = None if number else "scored"
        axis.axvspan(t[part.start], t[part.stop - 1], color="tab:green", alpha=0.08, label=label)
        if segment and len(run.figures["segments"]) > 1:
            value = run.figures["segments"][number]["rms_error_nm"]
            axis.text(
                t[(part.start + part.stop) // 2],
                0.97,
                f"{segment.frequency_hz:g} Hz\n{value:.3g}",
                transform=axis.get_xaxis_transform(),
                ha="center",
                va="top",
                fontsize="x-small",
            )


def loop(axis: Axes, runs: Sequence[Run]) -> None:
    """Draw y over the applied voltage."""
    for run in runs:
        part = slice(run.span.start, len(run.t))
        axis.plot(
            *curve(run, run.signal("u_applied"), run.signal("y", 1e6), part),
            linewidth=0.8,
            label=_named("", run, runs),
        )
    axis.set(
        title="Hysteresis loop, scored part",
        xlabel="applied voltage (V)",
        ylabel="displacement y (µm)",
    )


def _spectra(run: Run) -> list[tuple[np.ndarray, np.ndarray]]:
    """Lines (Hz) and density (nm^2/Hz) of the error in each scored part, by its share of them."""
    from scipy.signal import periodogram

    rate = SECOND / run.figures["sample_period_ns"]
    parts = list(run.parts.values())
    total = sum(part.stop - part.start for part in parts)
    found = []
    for segment, part in run.parts.items():
        share = (part.stop - part.start) / total
        length = _spectrum_length(part.stop - part.start, segment)
        number = (part.stop - part.start) // length
        S: Any = 0.0
        for i in range(number):
            some = slice(part.start + i * length, part.start + (i + 1) * length)
            f, density = periodogram(run.error(some), rate, window="boxcar", detrend=False)
            S = S + density * (share / number)
        found.append((f, S))
    return found


def _spectrum_length(samples: int, segment: Segment | None) -> int:
    """Samples of one spectrum: all, or of a long part a share that is averaged with the others.

    Of what repeats itself a share holds whole periods.
    """
    if samples <= LONG:
        return samples
    length = samples // math.ceil(samples / LONG)
    if segment is not None and segment.period <= length:
        length = round(int(length / segment.period) * segment.period)
    return length


def error_spectrum(run: Run) -> tuple[np.ndarray, np.ndarray]:
    """One-sided power spectral density of the error over the scored samples.

    Without a window: whole periods are lines. Parts of different length have different lines; each
    is taken as constant about its own.

    Returns
    -------
    f : array
        Frequency (Hz), the lines of the longest part.
    S : array
        Density (nm^2/Hz); of a single part its sum times the step of f is the mean square of the
        error.
    """
    spectra = _spectra(run)
    f = max((lines for lines, _ in spectra), key=len)
    density = np.zeros(len(f))
    for lines, S in spectra:
        nearest = np.round(f / lines[1]).astype(int) if len(lines) > 1 else np.zeros(len(f), int)
        density += S[np.minimum(nearest, len(S) - 1)]
    return f, density


def error_power(run: Run) -> tuple[np.ndarray, np.ndarray]:
    """Power of the error below each frequency, over the scored samples.

    Returns
    -------
    f : array
        Frequencies (Hz) of the lines of all scored parts, rising.
    P : array
        Power up to there (nm^2); the last is the mean square of the error over the scored samples.
    """
    spectra = _spectra(run)
    f = np.concatenate([lines for lines, _ in spectra])
    steps = [
        lines[1] if len(lines) > 1 else SECOND / run.figures["sample_period_ns"]
        for lines, _ in spectra
    ]
    P = np.concatenate([S * step for (_, S), step in zip(spectra, steps)])
    order = np.argsort(f, kind="stable")
    return f[order], np.cumsum(P[order])


def spectrum(axis: Axes, runs: Sequence[Run]) -> None:
    """Draw the error's amplitude density over frequency."""
    for run in runs:
        f, S = error_spectrum(run)
        density = np.sqrt(S[1:])
        floor = max(DECADES * float(density.max(initial=0.0)), 1e-12)  # 0 has no logarithm
        density = np.maximum(density, floor)
        axis.loglog(*thin_log(f[1:], density), linewidth=0.8, label=_named("", run, runs))
    axis.set(
        title="Spectrum of the error, scored part",
        xlabel="frequency (Hz)",
        ylabel="density (nm/Hz^0.5)",
    )


def power(axis: Axes, runs: Sequence[Run]) -> None:
    """Draw the power of the error up to each frequency."""
    for run in runs:
        f, P = error_power(run)
        some = f > 0.0
        if some.any():
            label = f"rms {np.sqrt(P[-1]):.4g} nm"
            axis.semilogx(*thin_log(f[some], P[some]), label=_named(label, run, runs))
    axis.set(
        title="Cumulative power of the error, constant part included",
        xlabel="frequency (Hz)",
        ylabel="power below (nm^2)",
        ylim=(0.0, None),
    )


def disturbance(axis: Axes, runs: Sequence[Run]) -> None:
    """Draw the observer's estimate of eps, and eps where it is known."""
    for run in runs:
        axis.plot(
            *line(run, run.signal("eps_hat")),
            linewidth=0.8,
            label=_named("estimate", run, runs),
        )
        if run.true is not None:
            true = run.true["eps"]
            axis.plot(
                *line(run, lambda part, eps=true: eps[part]),  # type: ignore[misc]
                "--",
                linewidth=0.8,
                label=_named("true", run, runs),
            )
    axis.set(title="Disturbance eps", xlabel="time (s)", ylabel="eps (V)")


def histogram(axis: Axes, runs: Sequence[Run]) -> None:
    """Draw how often the error has which value, where it is scored."""
    for run in runs:
        spread = Spread()
        for part in run.parts.values():
            for some in run.pieces(part):
                spread.add(run.error(some))
        counts, edges = np.zeros(BINS, int), np.empty(0)
        for part in run.parts.values():
            for some in run.pieces(part):
                more, edges = np.histogram(run.error(some), BINS, (spread.low, spread.high))
                counts = counts + more
        label = f"rms {spread.rms:.4g} nm, max {spread.largest:.4g} nm"
        axis.stairs(counts, edges, label=_named(label, run, runs))
    axis.set(
        title="Histogram of the error, scored part",
        xlabel="error x1 - w (nm)",
        ylabel="samples",
        yscale="log",
    )


Panel = Callable[[Axes, Sequence[Run]], None]

SHORT: tuple[Panel, ...] = (tracking, voltage, errors, loop)
"""Panels of ``report.png``."""

PANELS: tuple[Panel, ...] = (
    *(tracking, errors, last_tracking, last_error, voltage, loop),
    *(spectrum, power, disturbance, histogram),
)
"""All of them."""


BY_NAME: dict[str, Panel] = {
    "tracking": tracking,
    "error": errors,
    "tracking_end": last_tracking,
    "error_end": last_error,
    "voltage": voltage,
    "hysteresis": loop,
    "spectrum": spectrum,
    "power": power,
    "disturbance": disturbance,
    "histogram": histogram,
}
"""Panels as ``pea figure`` calls them."""


def paper(runs: Sequence[Run], names: Sequence[str]) -> Figure:
    """Panels below each other, for a column of a paper; legends stand outside the data."""
    plot, axes = plt.subplots(
        len(names), 1, figsize=(6.4, 2.6 * len(names)), squeeze=False, layout="constrained"
    )
    for name, axis in zip(names, axes.flat):
        BY_NAME[name](axis, runs)
        axis.grid(True, alpha=0.3)
        if axis.get_legend_handles_labels()[0]:
            axis.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), fontsize="small")
    return plot


def figure(title: str, runs: Sequence[Run], panels: Sequence[Panel] = PANELS) -> Figure:
    """Draw panels, two beside each other."""
    rows = len(panels) // 2
    plot, axes = plt.subplots(rows, 2, figsize=(12, 4 * rows))
    lines = 0
    for panel, axis in zip(panels, axes.flat):
        panel(axis, runs)
        axis.grid(True, alpha=0.3)
        lines = max(lines, legend(axis))
        for line in axis.lines if len(runs) > 1 else ():
            line.set_alpha(0.7)  # what lies under it
    # a layout that fits itself would draw everything twice
    gap, top = 0.85 + LEGEND_LINE * lines, 0.75 + LEGEND_LINE * lines
    height = rows * PANEL + (rows - 1) * gap + top + 0.5
    plot.set_figheight(height)
    plot.subplots_adjust(0.07, 0.5 / height, 0.985, 1.0 - top / height, 0.17, gap / PANEL)
    plot.suptitle(printable(title, TITLE_MAX), y=1.0 - 0.2 / height, va="center")
    return plot


def times(samples: int, T_s: float) -> np.ndarray:
    """Loop time (s) of each sample."""
    t = empty(samples)
    for part in pieces(samples, t):
        t[part] = np.arange(part.start, part.stop) * T_s
    return t


def draw(
    path: Path,
    experiment: Experiment,
    figures: dict[str, object],
    samples: np.ndarray,
    true: np.ndarray | None,
    begin: int = 0,
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
    begin : int
        First sample after the soft start.
    """
    t = times(len(samples), experiment.T_s)
    run = Run(experiment.name, t, samples, true, tuple(experiment.segments), figures, begin)
    save(figure(title_of(experiment), [run], SHORT), path)


def draw_response(
    path: Path, experiment: Experiment, figures: dict[str, object], response: Response
) -> None:
    """Write `response_figure` as PNG."""
    save(response_figure(experiment, figures, response), path)


def response_figure(
    experiment: Experiment, figures: dict[str, object], response: Response
) -> Figure:
    """Draw gain and phase of a measured frequency response over the model's.

    Parameters
    ----------
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
    plot.suptitle(title_of(experiment))

    def decibels(V: np.ndarray) -> np.ndarray:
        return 20.0 * np.log10(np.abs(V) * 1e6)

    def degrees(V: np.ndarray) -> np.ndarray:
        return np.degrees(np.unwrap(np.angle(V)))

    for axis, of, mark, found, title in (
        (axes[0, 0], decibels, "-3 dB", figures["minus_3_dB_hz"], "Gain (dB of 1 µm/V)"),
        (axes[1, 0], degrees, "-90 deg", figures["minus_90_degrees_hz"], "Phase (deg)"),
    ):
        axis.semilogx(f, of(model), label="model, Eq 2")
        axis.semilogx(f, of(held), ":", label="model with the hold of a sample")
        axis.semilogx(response.f, of(response.V), "o", markersize=4, label="measured")
        if found is not None:
            axis.axvline(found, color="tab:red", linewidth=0.8, label=f"{mark} at {found:.1f} Hz")
        axis.set(title=title)
    ratio = response.V / at_lines
    for axis, values, title in (
        (axes[0, 1], 20.0 * np.log10(np.abs(ratio)), "Measured against model, gain (dB)"),
        (axes[1, 1], np.degrees(np.angle(ratio)), "Measured against model, phase (deg)"),
    ):
        axis.semilogx(response.f, values, "o-", markersize=4, linewidth=0.8)
        axis.set(title=title)
    for axis in axes.flat:
        axis.grid(True, alpha=0.3)
        legend(axis)
    for axis in axes[1]:
        axis.set(xlabel="frequency (Hz)")
    return plot
