"""What lies in the directory of a run, and what its plant has said of itself."""

from __future__ import annotations

import math
from pathlib import Path

from pea_core.units import SECOND
from pea_record.messages import diagnostics

METRICS = "metrics.json"
REPORT = "report.png"
DEADLINES = "deadlines.png"

GATE, COUNTS = "pea: plant: gate", ("late", "missing", "overruns")
"""Diagnostic of a plant in wall time, and what it has counted."""

SOFT_START = "soft_start_s"
"""Key of the same diagnostic: longest time that its soft start takes."""


def soft_start(out: Path, T_ns: int) -> int:
    """Samples that the soft start of a rig takes at most, as its gate has told; 0 without one."""
    return math.ceil(soft_start_s(out).get(SOFT_START, 0.0) * SECOND / T_ns - 1e-6)


def soft_start_s(out: Path) -> dict[str, float]:
    """The same (s), where there is a rig."""
    values = gate(out)
    return {SOFT_START: float(values[SOFT_START])} if SOFT_START in values else {}


def gate(out: Path) -> dict[str, str]:
    """What the safety gate of a plant in wall time has told last."""
    told = [status for _, status in diagnostics(out) if status.name == GATE]
    return {pair.key: pair.value for pair in told[-1].values} if told else {}


def commands(out: Path) -> dict[str, int]:
    """What a plant in wall time has counted: commands late and missing, periods overrun."""
    values = gate(out)
    return {name: int(values[name]) for name in COUNTS if name in values}
