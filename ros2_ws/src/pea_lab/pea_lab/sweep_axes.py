"""Sweeps of an experiment of several axes: each run by the kernels of ``pea run --mode batch``.

Lanes carry one axis. So these runs take turns, on all cores, and nothing is kept of them but what
was asked for.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from pea_core.axes import one_axis
from pea_core.loop import blocks_of, trace
from pea_engine.compiled import wanted
from pea_experiment import score
from pea_experiment.experiment import MultiAxis
from pea_experiment.metrics import together, truth

TRUE = ("x1", "x2", "eps")
"""Signals that no sensor tells."""


class AxesRun(NamedTuple):
    """What came of one run: figures, signals (SI), first sample without a finite command or -1."""

    figures: dict[str, float]
    signals: dict[str, np.ndarray]
    failed_at: int


def names(axes: Sequence[str], keys: Sequence[str]) -> list[str]:
    """Names of figures or signals of each axis, as `pea.load` writes them."""
    return [f"{axis}.{key}" for axis in axes for key in keys]


def run(experiment: MultiAxis, keep: Sequence[str]) -> AxesRun:
    """Run an experiment once."""
    loop = experiment.loop(wanted(experiment.samples))
    rows = trace([loop.run(n) for n in blocks_of(experiment.samples, loop.piece)])
    signals = {name: np.full(experiment.samples, np.nan) for name in names(experiment.axes, keep)}
    failed = loop.fault is not None
    plant, nominal = experiment.plant(), tuple(one.nominal for one in experiment.each)
    true = truth(plant, rows, nominal) if len(rows) else None
    by_axis: dict[str, Any] = {}
    for i, one in enumerate(experiment.each):
        own, own_true = one_axis(rows, i), None if true is None else one_axis(true, i)
        for name in keep:
            source = own_true if name in TRUE else own
            if source is not None:
                signals[f"{one.axis}.{name}"][: len(rows)] = source[name]
        if not failed:
            by_axis[one.axis] = one.figures(own, own_true)
    if failed:
        return AxesRun({}, signals, len(rows))
    figures = {k: v for k, v in together(by_axis, rows).items() if k in score.UNITS}
    for axis, found in by_axis.items():
        figures |= {f"{axis}.{name}": found[name] for name in score.UNITS}
    return AxesRun({k: np.nan if v is None else v for k, v in figures.items()}, signals, -1)
