"""What lies in the directory of a run, and what its plant has said of itself."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

from pea_core.units import SECOND
from pea_record.messages import diagnostics
from pea_record.recording import Recording
from pea_wire.topics import DIAGNOSTICS

METRICS = "metrics.json"
REPORT = "report.png"
DEADLINES = "deadlines.png"

GATE, COUNTS = "pea: plant: gate", ("late", "missing", "overruns")
"""Diagnostic of a plant in wall time, and what it has counted."""

SOFT_START = "soft_start_s"
"""Key of the same diagnostic: longest time that its soft start takes."""


def soft_start(told: Mapping[str, str], T_ns: int) -> int:
    """Samples that the soft start of a rig takes at most, as its gate has told; 0 without one."""
    return math.ceil(float(told.get(SOFT_START, 0.0)) * SECOND / T_ns - 1e-6)


def gate(out: Path, recording: Recording | None = None) -> dict[str, str]:
    """What the safety gate of a plant in wall time has told last.

    A recording that was read already says whether there is anything to look for.
    """
    if recording is not None and not recording.counts.get(DIAGNOSTICS.name):
        return {}
    told = [status for _, status in diagnostics(out) if status.name == GATE]
    return {pair.key: pair.value for pair in told[-1].values} if told else {}


def commands(out: Path) -> dict[str, int]:
    """What a plant in wall time has counted: commands late and missing, periods overrun."""
    values = gate(out)
    return {name: int(values[name]) for name in COUNTS if name in values}
