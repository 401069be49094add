"""True states beside a recording, where its plant was simulated."""

from __future__ import annotations

import numpy as np

from pea_experiment.metrics import truth
from pea_record.frame import Frame
from pea_record.read import BagError
from pea_report.replay import experiment_of

COLUMNS = {"x1": "m", "x2": "m/s", "eps": "V"}
"""Columns that are added, and their units."""


def add_truth(frame: Frame) -> None:
    """Add x1, x2 and eps of the simulated plant, by driving it with the recorded commands.

    Raises
    ------
    BagError
        The plant was a device, or its parameters changed during the run: nobody knows them.
    """
    recording = frame.recording
    experiment = experiment_of(recording, frame.path)
    plant = experiment.plant()
    true = None
    if hasattr(plant, "truth"):
        true = truth(plant, recording.samples, experiment.nominal)
    if true is None:
        raise BagError(
            f"{frame.path}: the true states are not known: the plant was a device, or its "
            "parameters changed during the run; leave the truth out"
        )
    first = int(np.searchsorted(recording.stamps * 1e-9, frame.t[0]))
    for name, unit in COLUMNS.items():
        frame.add(name, unit, true[name][first : first + len(frame)])
