"""Which samples of a run are scored, and what warns that they may not be what was meant.

Each part of the reference that repeats itself (one sine, or each sine of a series) is scored by
itself, over the last whole periods that lie in the second half of that part, at least one. Of a
series that begins again, the last whole round counts. A reference that does not repeat itself, or
not within the run, is scored over the second half of the run. The soft start of a rig is not
scored: what is said of a part holds from its end on.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

MOVED = 10e-9
"""Change of level (m) from which on it counts as a move."""


class Segment(NamedTuple):
    """A part of the reference that repeats itself.

    Attributes
    ----------
    start, end : float
        First sample, and the one after the last; inf where it goes on.
    period : float
        Period (samples).
    frequency_hz : float
        Its frequency.
    """

    start: float
    end: float
    period: float
    frequency_hz: float


class Move(NamedTuple):
    """The reference's last change of level: first sample, and level (m)."""

    start: int
    level: float


def of_round(segments: Sequence[Segment], samples: int) -> list[Segment]:
    """Segments of the last whole round in `samples`, of a series that begins again; else as given.

    Parameters
    ----------
    segments : sequence of Segment
        Those of the first round; it begins again where the last of them ends.
    samples : int
        Length of the run.
    """
    length = segments[-1].end if segments else math.inf
    rounds = max(int(samples / length + 1e-9) - 1, 0)
    if not rounds:
        return list(segments)
    shift = rounds * length
    return [s._replace(start=s.start + shift, end=s.end + shift) for s in segments]


def scored(
    samples: int, segments: Sequence[Segment], begin: int = 0
) -> dict[Segment | None, slice]:
    """Samples over which a run is scored: those of each segment, or the second half.

    Parameters
    ----------
    samples : int
        Length of the run.
    segments : sequence of Segment
        Parts of the reference that repeat themselves.
    begin : int
        First sample after the soft start; where the run ends before, all of it counts.
    """
    begin = begin if begin < samples else 0
    parts: dict[Segment | None, slice] = {}
    for segment in segments:
        start, end = _span(segment, samples, begin)
        if end - start < segment.period - 0.5:
            continue
        periods = max(int((end - start) / 2 / segment.period + 1e-9), 1)
        parts[segment] = slice(max(end - round(periods * segment.period), start), end)
    return parts or {None: slice(begin + (samples - begin) // 2, samples)}


def _span(segment: Segment, samples: int, begin: int) -> tuple[int, int]:
    """First sample of a segment that may be scored, and the first one after it."""
    end = samples if segment.end >= samples else round(segment.end)
    return max(round(segment.start), begin), end


def scoring(
    samples: int, segments: Sequence[Segment], T_s: float, begin: int = 0
) -> tuple[str, list[str]]:
    """What is scored, in words, and a warning for each way in which the run is too short.

    Parameters
    ----------
    samples, segments, begin
        As of `scored`.
    T_s : float
        Sample period (s).
    """
    warnings = []
    if begin >= samples:
        warnings.append(
            f"the run ends within the soft start of {begin * T_s:g} s, which is scored with it: "
            "run it longer"
        )
        begin = 0
    parts = scored(samples, segments, begin)
    said = []
    for segment, part in parts.items():
        span = f"{part.start * T_s:.10g} to {part.stop * T_s:.10g} s"
        if segment is None:
            said.append(f"{span} (second half)")
            continue
        periods = (part.stop - part.start) / segment.period
        many = f"{periods:.0f} periods" if periods > 1.5 else "1 period"
        said.append(f"{span} ({many} of {segment.frequency_hz:g} Hz)")
    short = [s for s, p in parts.items() if s is not None and _starts_early(s, p, samples, begin)]
    missed = [s for s in segments if s not in parts]
    if missed:
        last = missed[-1]
        need = last.end if math.isfinite(last.end) else max(last.start, begin) + 2 * last.period
        what = "its second half is scored instead" if None in parts else "not scored"
        warnings.append(
            f"the run holds no whole period of {_hertz(missed)}: {what}; "
            f"{need * T_s:.6g} s are long enough"
        )
    for cut, told in (
        (True, "the run holds less than two periods of {}: the last is scored, start-up included"),
        (False, "the reference holds one period of {}: what comes before it is scored too"),
    ):
        if few := [s for s in short if (s.end > samples) is cut]:
            need = max(max(s.start, begin) + 2 * s.period for s in few) * T_s
            more = f"{need:.6g} s are long enough" if cut else "give reference.periods of 2 or more"
            warnings.append(f"{told.format(_hertz(few))}; {more}")
    return "; ".join(said), warnings


def _starts_early(segment: Segment, part: slice, samples: int, begin: int) -> bool:
    """Whether a part is scored from before the middle of its segment."""
    start, end = _span(segment, samples, begin)
    return part.start < (start + end) / 2 - 1.0


def _hertz(segments: Sequence[Segment]) -> str:
    return ", ".join(f"{s.frequency_hz:g}" for s in segments) + " Hz"


def unsettled(
    figures: Mapping[str, Any], x1: np.ndarray, move: Move | None, T_s: float
) -> list[str]:
    """Warn where the transient of a move is scored, or the run ends before the move.

    Parameters
    ----------
    figures : dict
        What `metrics` and `transient` give.
    x1, move, T_s
        As of `transient`.
    """
    if move is None or abs(move.level - x1[min(move.start, len(x1) - 1)]) < MOVED:
        return []
    begun = f"the change of level at {move.start * T_s:.6g} s"
    if move.start >= len(x1):
        return [f"the run ends before {begun}: run it longer"]
    if figures["settling_time_ms"] is None:
        return [f"{begun} has not settled to 2 %: its transient is scored; run it longer"]
    settled = move.start + round(figures["settling_time_ms"] / (T_s * 1e3))
    if settled <= figures["scored_from_sample"]:
        return []
    need = 2 * settled * T_s
    return [
        f"{begun} settles at {settled * T_s:.6g} s: its transient is scored; "
        f"{need:.6g} s are long enough"
    ]
