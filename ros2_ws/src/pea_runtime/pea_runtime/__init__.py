"""Experiments, the three ways to run the loop, recorder, metrics, report, command line."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from pea_runtime.record.frame import Frame
    from pea_runtime.sweep import Sweep


def load(path: str | Path, start: float | None = None, end: float | None = None) -> Frame:
    """Open a recording, or a part of it (s of loop time): `pea_runtime.record.frame.load`."""
    from pea_runtime.record.frame import load

    return load(path, start, end)


def simulate(experiment: str, vary: Mapping[str, Any] | None = None, **options: Any) -> Sweep:
    """Run an experiment many times with other values: `pea_runtime.sweep.simulate`."""
    from pea_runtime.sweep import simulate

    return simulate(experiment, vary, **options)
