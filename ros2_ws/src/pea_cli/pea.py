"""The library by its short name: ``pea.load``, ``pea.simulate``, ``pea.systems``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from pea_lab.sweep import Sweep
    from pea_record.frame import Frame

__all__ = ["load", "simulate", "systems"]


def load(
    path: str | Path,
    start: float | None = None,
    end: float | None = None,
    truth: bool = False,
) -> Frame:
    """Open a recording, or a part of it (s of loop time): `pea_record.frame.load`.

    `truth` adds the columns x1, x2 and eps of a simulated plant: what no sensor told.
    """
    from pea_record.frame import load

    frame = load(path, start, end)
    if truth:
        from pea_report.true_states import add_truth

        add_truth(frame)
    return frame


def systems(experiment: str, sets: Sequence[str] = ()) -> dict[str, Any]:
    """Stage, observer, law and loop as python-control objects: `pea_lab.linear.systems`."""
    from pea_experiment.experiments import load
    from pea_lab.linear import systems

    return systems(load(experiment, sets))


def simulate(experiment: str, vary: Mapping[str, Any] | None = None, **options: Any) -> Sweep:
    """Run an experiment many times with other values: `pea_lab.sweep.simulate`."""
    from pea_lab.sweep import simulate

    return simulate(experiment, vary, **options)
