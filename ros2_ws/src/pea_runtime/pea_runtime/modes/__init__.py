"""The three ways to run an experiment. Each records a bag; everything else is read from it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from pea_runtime.experiments import Experiment
from pea_runtime.modes import batch, composed, distributed

Progress = Callable[[int], None]
"""Told how many samples are done."""

Mode = Callable[[Experiment, Path, Progress], None]

MODES: dict[str, Mode] = {
    "batch": batch.run,
    "composed": composed.run,
    "distributed": distributed.run,
}
