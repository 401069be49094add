"""What a run was worth: `metrics.json`.

The error is x1 - w, x1 the true displacement where the plant is simulated, else the measured one.
Rms and maximum of the run are over all scored parts together (`scoring`), in percent of half the
reference's stroke there.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from pea_core import axes
from pea_core.axes import per_axis
from pea_core.nominal import NominalModel
from pea_core.signals import FINE, TRUTH
from pea_core.signals import UNITS as SI
from pea_core.units import NM_PER_M
from pea_engine.compiled import wanted
from pea_engine.kernels import DRIVEN, drive_kernel
from pea_experiment.scoring import MOVED, Move, Segment, scored
from pea_record import large
from pea_record.large import empty, pieces

TRACE = ("y", "x1_hat", "x2_hat", "eps_hat", "u", "u_applied")
"""Arrays of `trace_sha256`, in order."""

SETTLED = 0.02
"""Share of its height within which a move counts as settled."""

UNITS = {
    "nm": "nm",
    "percent": "%",
    "V": "V",
    "um": "um",
    "um_s": "um/s",
    "Hz": "Hz",
    "hz": "Hz",
    "deg": "deg",
    "dB": "dB",
    "ms": "ms",
    "s": "s",
    "ns": "ns",
}
"""Unit of a metric by the end of its name."""

PER = {"s": "s", "V": "V", "decade": "decade", "rtHz": "√Hz"}
"""What a metric is counted by, where its name ends in ``_per_`` and this."""


def unit(name: str) -> str:
    """Unit of a metric; empty where it has none."""
    if "_us_" in name:
        return "us"
    whole, _, below = name.rpartition("_per_")
    if whole and below in PER:
        return f"{unit(whole) or 1}/{PER[below]}"
    return next((text for end, text in UNITS.items() if name.endswith(f"_{end}")), "")


def trace_sha256(samples: np.ndarray) -> str:
    """Digest of the float64 little-endian arrays of `TRACE`, one after the other."""
    digest = hashlib.sha256()
    for name in TRACE:
        for part in pieces(len(samples), samples):
            digest.update(np.ascontiguousarray(samples[name][part], "<f8").tobytes())
    return digest.hexdigest()


def truth(plant: Any, samples: np.ndarray, nominal: Any) -> np.ndarray | None:
    """True states of a simulated run, by driving a new plant with the recorded commands.

    Parameters
    ----------
    plant : Simulated or Stage
        At rest, with the run's parameters; it ends where the run has ended.
    samples : (n,) or (n, axes) array of `SAMPLE`
        The run.
    nominal : NominalModel, or tuple of them
        Eq 2, which defines eps: (x2' - A21 x1 - A22 x2) / B2 - u_applied, with x2' and
        u_applied of the interval that ended at the sample.

    Returns
    -------
    (n,) or (n, axes) array of `TRUTH`, or None
        None where the plant does not repeat the recorded y bit by bit: its parameters were
        changed during the run, so what is recorded does not tell the truth.
    """
    found = empty(samples.shape, TRUTH)
    models = per_axis(nominal)
    compiled = drive_kernel(plant.model) if wanted(len(samples)) else None
    for part in pieces(len(samples), samples, found):
        seen = np.empty((part.stop - part.start, len(DRIVEN) * len(models)))
        u = np.ascontiguousarray(samples["u"][part])
        if compiled is not None:
            plant.s = compiled(plant.c, plant.s, plant.noise(len(u)), u, seen)
        else:
            for i, u_k in enumerate(u.tolist()):
                measured = per_axis(plant.read())
                told = zip(measured, per_axis(plant.truth), strict=True)
                seen[i] = [value for one, true in told for value in (one.y, *true)]
                plant.write(u_k)
        table = seen.reshape(len(seen), len(models), -1)
        own, true_own = axes.table(samples[part]), axes.table(found[part])
        for axis, model in enumerate(models):
            y, x1, x2, x2_dot = table[:, axis].T
            if not np.array_equal(y, own["y"][:, axis]):
                return None
            into = true_own[:, axis]
            into["x1"], into["x2"] = x1, x2
            into["eps"] = unknown_input(model, x1, x2, x2_dot, own["u_applied"][:, axis])
    return found


def unknown_input(
    nominal: NominalModel,
    x1: np.ndarray,
    x2: np.ndarray,
    x2_dot: np.ndarray,
    u_applied: np.ndarray,
) -> np.ndarray:
    """The eps (V) of Eq 2 that true states (SI) and the applied voltage (V) leave: (n,) array."""
    eps: np.ndarray = (x2_dot - nominal.A21 * x1 - nominal.A22 * x2) / nominal.B2 - u_applied
    return eps


WORST = ("max_error_nm", "rms_error_percent", "rms_voltage_step_V", "eps_max_V", "eps_left_max_V")
"""Metrics of which the largest of all axes stands for the stage, and those of the observer."""


def together(each: dict[str, dict[str, Any]], samples: np.ndarray) -> dict[str, Any]:
    """Figures of a stage from those of its axes.

    The rms error is that of the vector of errors, the root of the axes' squares added up. Of other
    figures the largest of an axis counts.

    Parameters
    ----------
    each : dict of str to dict
        `metrics` of each axis, by its name.
    samples : (n, axes) array of `SAMPLE`
        The run.
    """
    own = list(each.values())
    figures: dict[str, Any] = {
        "rms_error_nm": math.sqrt(sum(one["rms_error_nm"] ** 2 for one in own))
    }
    worst = [*WORST, *(name for name in own[0] if name.startswith("observer_rms"))]
    for name in worst:
        values = [one[name] for one in own]
        figures[name] = None if None in values else max(values)
    figures["saturated_samples"] = sum(one["saturated_samples"] for one in own)
    figures["scored_from_sample"] = min(one["scored_from_sample"] for one in own)
    figures["trace_sha256"] = trace_sha256(samples)
    return {**figures, "axes": each}


def rms(values: np.ndarray) -> float:
    """Root mean square."""
    return float(math.sqrt(float(np.mean(np.square(values)))))


class Spread:
    """Mean square and extremes of values that come in pieces."""

    def __init__(self) -> None:
        self.count, self.squares = 0, 0.0
        self.low, self.high = math.inf, -math.inf

    def add(self, values: np.ndarray) -> None:
        """Take more of them."""
        if len(values):
            self.count += len(values)
            self.squares += float(np.sum(np.square(values)))
            self.low = float(np.minimum(self.low, values.min()))  # of no number, none
            self.high = float(np.maximum(self.high, values.max()))

    @property
    def rms(self) -> float:
        """Root mean square; 0 where nothing has come."""
        return math.sqrt(self.squares / self.count) if self.count else 0.0

    @property
    def largest(self) -> float:
        """Largest magnitude."""
        return max(abs(self.low), abs(self.high))


def _places(parts: Sequence[slice]) -> Iterator[np.ndarray]:
    """Numbers of the samples of some parts, so many at a time as are looked at together."""
    held: list[np.ndarray] = []
    room = large.PIECE
    for part in parts:
        at = part.start
        while at < part.stop:
            stop = min(at + room, part.stop)
            held.append(np.arange(at, stop))
            room -= stop - at
            at = stop
            if not room:
                yield np.concatenate(held)
                held, room = [], large.PIECE
    if held:
        yield np.concatenate(held)


def _tracking(parts: Sequence[slice], x1: np.ndarray, w: np.ndarray) -> dict[str, Any]:
    """Rms and maximum of x1 - w over some parts in nm, rms in percent of half the stroke of w."""
    error, desired = Spread(), Spread()
    for at in _places(parts):
        w_at = w[at]
        error.add(x1[at] - w_at)
        desired.add(w_at)
        large.give_back(x1)
        large.give_back(w)
    amplitude = (desired.high - desired.low) / 2.0
    return {
        "rms_error_nm": error.rms * NM_PER_M,
        "max_error_nm": error.largest * NM_PER_M,
        "rms_error_percent": 100.0 * error.rms / amplitude if amplitude > 0.0 else None,
    }


def transient(x1: np.ndarray, move: Move | None, T_s: float) -> dict[str, float | None]:
    """How a move goes: time from 10 % to 90 %, overshoot, time after which it stays within 2 %.

    Parameters
    ----------
    x1 : (n,) array
        Displacement (m).
    move : Move or None
        None where the reference makes none.
    T_s : float
        Sample period (s).

    Returns
    -------
    dict
        All None where there is no move of 10 nm or more, or it is not over.
    """
    figures: dict[str, float | None] = dict.fromkeys(
        ("rise_time_ms", "overshoot_percent", "settling_time_ms")
    )
    if move is None or move.start >= len(x1):
        return figures
    height = move.level - x1[move.start]
    if abs(height) < MOVED:
        return figures
    first = x1[move.start]
    overshoot, outside, risen, begun = 0.0, -1, -1, -1
    moving = x1[move.start :]
    for part in pieces(len(moving), moving):
        done = (moving[part] - first) / height
        beyond = np.flatnonzero(np.abs(done - 1.0) > SETTLED)
        outside = part.start + int(beyond[-1]) if len(beyond) else outside
        for share, at in ((0.9, risen), (0.1, begun)):
            if at < 0 and (reached := np.flatnonzero(done >= share)).size:
                at = part.start + int(reached[0])
            risen, begun = (at, begun) if share == 0.9 else (risen, at)
        overshoot = max(overshoot, float(done.max()) - 1.0)
    if outside == len(moving) - 1:
        return figures
    figures["rise_time_ms"] = (risen - begun) * T_s * 1e3
    figures["overshoot_percent"] = overshoot * 100.0
    figures["settling_time_ms"] = (outside + 1) * T_s * 1e3
    return figures


def metrics(
    samples: np.ndarray,
    true: np.ndarray | None,
    segments: Sequence[Segment],
    voltage_min: float,
    voltage_max: float,
    begin: int = 0,
) -> dict[str, Any]:
    """Figures of a run that follow from its samples alone.

    Parameters
    ----------
    samples : (n,) array of `SAMPLE`
        One axis of the run, n > 0.
    true : (n,) array of `TRUTH` or None
        From `truth`.
    segments : sequence of Segment
        Parts of the reference that repeat themselves.
    voltage_min, voltage_max : float
        What the actuator can apply (V).
    begin : int
        First sample after the soft start.
    """
    parts = scored(len(samples), segments, begin)
    spans = list(parts.values())
    w, u = samples["w"], samples["u"]
    x1 = samples["y"] if true is None else true["x1"]
    steps = Spread()
    for at in _places(spans):
        at = at[at < len(u) - 1]
        steps.add(u[at + 1] - u[at])
        large.give_back(samples)
    saturated = 0
    eps, eps_left = Spread(), Spread()
    for part in pieces(len(samples), samples, *(() if true is None else (true,))):
        saturated += int(np.count_nonzero((u[part] < voltage_min) | (u[part] > voltage_max)))
        if true is not None:
            eps.add(true["eps"][part])
            eps_left.add(true["eps"][part] - samples["eps_hat"][part])
    figures: dict[str, Any] = {
        **_tracking(spans, x1, w),
        "segments": [
            {"frequency_hz": segment.frequency_hz, **_tracking([p], x1, w)}
            for segment, p in parts.items()
            if segment is not None
        ],
        "rms_voltage_step_V": steps.rms,
        "saturated_samples": saturated,
        "scored_from_sample": spans[0].start,
        "eps_max_V": None if true is None else eps.largest,
        "eps_left_max_V": None if true is None else eps_left.largest,
    }
    for name, unit in (("x1", "nm"), ("x2", "um_s"), ("eps", "V")):
        gap = None if true is None else estimate_gap(name, samples, true, spans)
        figures[f"observer_rms_{name}_{unit}"] = gap
    figures["trace_sha256"] = trace_sha256(samples)
    return figures


def estimate_gap(name: str, samples: np.ndarray, true: np.ndarray, spans: Sequence[slice]) -> float:
    """Rms of the estimate of x1, x2 or eps minus the truth over `spans`, in the unit reported."""
    gap = Spread()
    for at in _places(spans):
        gap.add(samples[f"{name}_hat"][at] - true[name][at])
        large.give_back(samples)
        large.give_back(true)
    return gap.rms * FINE[SI[name]][1]
