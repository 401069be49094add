"""Experiments, the three ways to run the loop, recorder, metrics, report, command line."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

    from pea_runtime.record.frame import Frame


def load(path: str | Path) -> Frame:
    """Read a recording: `pea_runtime.record.frame.load`."""
    from pea_runtime.record.frame import load

    return load(path)
