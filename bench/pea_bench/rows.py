"""Measured figures: rounds, medians, spreads, demands, and what was kept of an earlier run."""

from __future__ import annotations

import json
import statistics
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

KEYS = {
    "batch": (
        *("us_per_step", "sweep_us_per_step", "python_us_per_step", "opensmc_us_per_step"),
        *("ratio_vs_opensmc", "sweep_ratio_vs_opensmc"),
    ),
    "composed": (
        *("rate_hz", "missed_fraction", "empty_loop_missed_fraction", "lateness_us_p50"),
        *("lateness_us_p99", "lateness_us_p999", "lateness_us_max"),
    ),
    "distributed": (
        *("samples_per_s", "fast_samples_per_s", "naive_rclpy_samples_per_s"),
        *("ratio_vs_naive", "fast_ratio_vs_naive", "pipe_ring_samples_per_s"),
    ),
    "recorder": ("messages_per_s", "lost", "core_share_at_80k", "ratio_vs_naive"),
    "startup": ("distributed_s", "batch_s"),
    "hardware": (
        *("udp_exchange_us_p50", "udp_exchange_us_p999", "udp_missed_ratio"),
        *("udp_lateness_us_p999", "registers_exchange_us_p50", "registers_missed_ratio"),
        *("graph_late_1khz", "composed_missed_1khz", "graph_late_2khz", "composed_missed_2khz"),
    ),
    "axes": ("us_per_step", "ratio_2", "missed_ratio", "lock_step_ratio"),
}
"""The parts of a run, and what ``--json`` says of each."""

WORSE = 0.3
"""By what share of the kept ratio another must be worse to be told."""

Job = Callable[[], float]
Tick = Callable[[], None]


class Row(NamedTuple):
    """One figure, measured in several rounds.

    Attributes
    ----------
    name : str
        ``part.key``.
    what : str
        What was measured, in words.
    unit : str
        Of the values; empty for a ratio or a count.
    values : tuple of float
        One a round; none where it could not be measured.
    demand : str
        ``<= 2``: what it shall be, empty where nothing is asked. A ratio that has one is kept and
        compared.
    """

    name: str
    what: str
    unit: str
    values: tuple[float, ...]
    demand: str = ""

    @property
    def value(self) -> float | None:
        """The figure: the median of the rounds."""
        return statistics.median(self.values) if self.values else None

    @property
    def spread(self) -> tuple[float, float] | None:
        """Least and largest of the rounds."""
        return (min(self.values), max(self.values)) if self.values else None

    @property
    def fine(self) -> bool | None:
        """Whether the figure is as demanded; None where it is not known, or nothing is asked."""
        if not self.demand or self.value is None:
            return None
        sign, bound = self.demand.split()
        return self.value <= float(bound) if sign == "<=" else self.value >= float(bound)

    @property
    def compared(self) -> bool:
        """Whether it is a ratio that may be compared with another run's."""
        return bool(self.demand) and "ratio" in self.name


class Part(NamedTuple):
    """What one part of the bench has found.

    Attributes
    ----------
    rows : list of Row
    curves : dict
        Numbers of its plots, by name.
    notes : list of str
        What the reader must know of them.
    """

    rows: list[Row]
    curves: dict[str, Any]
    notes: list[str]


def best(job: Job, times: int = 3) -> float:
    """The least of several: what other programs take of the machine is not the job's."""
    return min(job() for _ in range(times))


def interleaved(
    jobs: Mapping[str, Job], rounds: int, tick: Tick = lambda: None
) -> dict[str, tuple[float, ...]]:
    """Do every job once a round, each second round backwards, so that drift meets all alike.

    Parameters
    ----------
    jobs : mapping of str to callable
        Each measures once and gives its figure.
    rounds : int
        How often.
    tick : callable
        Told after each job.
    """
    found: dict[str, list[float]] = {name: [] for name in jobs}
    for i in range(rounds):
        for name in reversed([*jobs]) if i % 2 else jobs:
            found[name].append(jobs[name]())
            tick()
    return {name: tuple(values) for name, values in found.items()}


def ratio(over: Iterable[float], under: Iterable[float]) -> tuple[float, ...]:
    """Ratios of the rounds; none where one of the two was not measured or is zero."""
    return tuple(a / b for a, b in zip(over, under) if b)


def figures(rows: Iterable[Row], parts: Iterable[str]) -> dict[str, dict[str, float | int | None]]:
    """What ``--json`` prints: the figures of `KEYS`, None where there is none."""
    found = {row.name: row.value for row in rows}
    return {part: {key: found.get(f"{part}.{key}") for key in KEYS[part]} for part in parts}


def worse(rows: Iterable[Row], kept: Iterable[Row]) -> list[str]:
    """Ratios that have got worse than the kept ones by more than `WORSE`, a line each."""
    before = {row.name: row.value for row in kept}
    told = []
    for row in rows:
        then = before.get(row.name)
        if not row.compared or row.value is None or not then:
            continue
        change = row.value / then - 1.0
        if not row.demand.startswith("<="):
            change = -change
        if change > WORSE:
            told.append(f"{row.name}: {row.value:.3g}, was {then:.3g}: worse by {change:.0%}")
    return told


def kept(path: Path) -> dict[str, Part]:
    """Parts of an earlier run; empty where none was kept."""
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        return {}
    return {
        name: Part(
            [Row(**{**row, "values": tuple(row["values"])}) for row in part["rows"]],
            part["curves"],
            part["notes"],
        )
        for name, part in json.loads(text)["parts"].items()
    }


def keep(path: Path, parts: Mapping[str, Part], machine: Mapping[str, str]) -> None:
    """Keep the parts of a run, in place of what was kept of the same parts."""
    whole = {**kept(path), **parts}
    told = {
        "machine": dict(machine),
        "parts": {
            name: {
                "rows": [row._asdict() for row in whole[name].rows],
                "curves": whole[name].curves,
                "notes": whole[name].notes,
            }
            for name in (*KEYS, *(n for n in whole if n not in KEYS))
            if name in whole
        },
    }
    draft = path.with_suffix(".tmp")
    draft.write_text(json.dumps(told, indent=1) + "\n", encoding="utf-8")
    draft.replace(path)
