"""The three ways to run an experiment. Each records a bag; everything else is read from it."""

from __future__ import annotations

from collections.abc import Callable

from pea_runtime.deadlines import Deadlines
from pea_runtime.modes import batch, composed, distributed

Progress = Callable[[int], None]
"""Told how many samples are done."""

Mode = Callable[..., Deadlines | None]
"""Takes the experiment, the directory, a `Progress` and options of its own."""

MODES: dict[str, Mode] = {
    "batch": batch.run,
    "composed": composed.run,
    "distributed": distributed.run,
}
