"""The library by its short name: ``pea.load`` and ``pea.simulate``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from pea_lab.sweep import Sweep
    from pea_record.frame import Frame

__all__ = ["load", "simulate"]


def load(path: str | Path, start: float | None = None, end: float | None = None) -> Frame:
    """Open a recording, or a part of it (s of loop time): `pea_record.frame.load`."""
    from pea_record.frame import load

    return load(path, start, end)


def simulate(experiment: str, vary: Mapping[str, Any] | None = None, **options: Any) -> Sweep:
    """Run an experiment many times with other values: `pea_lab.sweep.simulate`."""
    from pea_lab.sweep import simulate

    return simulate(experiment, vary, **options)
