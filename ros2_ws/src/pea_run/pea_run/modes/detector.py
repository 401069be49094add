"""The sample signal of a loop in this process, for its recording."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from pea_core import axes
from pea_experiment.experiment import AnyExperiment
from pea_experiment.metrics import truth
from pea_plant import specimen
from pea_plant.driven import Driven
from pea_record.rows import NO_SIGNAL

Signal = Callable[[np.ndarray], np.ndarray]
"""The sample signal of the next samples, by their rows; each is asked for once, in order."""


def signal_of(experiment: AnyExperiment, device: Driven | None = None) -> Signal:
    """What tells the sample signal: a device's driver, or what lies on the simulated stage.

    Raises
    ------
    ParameterError
        What lies there is no specimen.
    """
    if device is not None:
        return lambda rows: device.signal(len(rows))
    lies = specimen.of([one.nodes["plant"].params for one in experiment.each])
    if lies is None:
        return lambda rows: NO_SIGNAL
    # driven again with what was recorded, it tells where it truly was
    stage: Any = experiment.plant()
    nominal = tuple(one.nominal for one in experiment.each)

    def signal(rows: np.ndarray) -> np.ndarray:
        nonlocal stage
        true = None
        if stage is not None and len(rows):
            true = truth(stage, rows, nominal if len(nominal) > 1 else nominal[0])
            if true is None:  # its parameters have changed: the measured position is left
                stage = None
        found = axes.table(rows)["y"] if true is None else axes.table(true)["x1"]
        told: np.ndarray = specimen.at(lies, list(found.T))
        return told

    return signal
