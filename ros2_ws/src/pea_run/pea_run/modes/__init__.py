"""The three ways to run an experiment. Each records a bag; everything else is read from it."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import TYPE_CHECKING

from pea_core.config import MODES as NAMES

if TYPE_CHECKING:
    from pea_run.deadlines import Deadlines

Progress = Callable[[int], None]
"""Told how many samples are done."""

Mode = Callable[..., "Deadlines | None"]
"""Takes the experiment, the directory, a `Progress` and options of its own."""


def _mode(name: str) -> Mode:
    """A mode that is imported when it runs: batch needs nothing of ROS."""

    def run(*arguments: object, **options: object) -> Deadlines | None:
        module = importlib.import_module(f"{__name__}.{name}")
        found: Deadlines | None = module.run(*arguments, **options)
        return found

    return run


MODES = {name: _mode(name) for name in NAMES}
