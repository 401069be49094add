"""True states beside a recording, where its plant was simulated."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pea_core import axes
from pea_experiment.experiment import Experiment
from pea_experiment.metrics import truth
from pea_record.frame import Frame
from pea_record.read import load_axes, path_and_axis
from pea_record.recording import BagError, Recording
from pea_report.recorded import axes_experiment_of

COLUMNS = {"x1": "m", "x2": "m/s", "eps": "V"}
"""Columns that are added, and their units."""


def true_states(recording: Recording, path: Path) -> np.ndarray | None:
    """True states of a simulated run, from all axes of its plant; see `metrics.truth`.

    Parameters
    ----------
    recording : Recording
        Its first sample is that of the run.
    path : Path
        Where it was read from; of one axis ``PATH@AXIS``.

    Returns
    -------
    (n,) or (n, axes) array of `TRUTH`, or None
        Of the axes of the recording. None where nobody knows them: the plant was a device, or its
        parameters changed during the run.
    """
    there, axis = path_and_axis(path)
    whole = load_axes(there) if axis else recording  # the axes of a plant may act on each other
    experiment = axes_experiment_of(whole, there)
    plant = experiment.plant()
    if not hasattr(plant, "truth"):
        return None
    several = not isinstance(experiment, Experiment)
    nominal = tuple(one.nominal for one in experiment.each)
    true = truth(plant, whole.samples, nominal if several else nominal[0])
    if true is None or not axis:
        return true
    return np.ascontiguousarray(axes.one_axis(true, whole.axes.index(axis)))


def add_truth(frame: Frame) -> None:
    """Add x1, x2 and eps of the simulated plant, by driving it with the recorded commands.

    Raises
    ------
    BagError
        The plant was a device, or its parameters changed during the run: nobody knows them.
    """
    recording = frame.recording
    true = true_states(recording, frame.path)
    if true is None:
        raise BagError(
            f"{frame.path}: the true states are not known: the plant was a device, or its "
            "parameters changed during the run; leave the truth out"
        )
    first = int(np.searchsorted(recording.stamps * 1e-9, frame.t[0]))
    for i, axis in enumerate(frame.axes):
        own = axes.one_axis(true, i)
        for name, unit in COLUMNS.items():
            told = name if len(frame.axes) == 1 else f"{axis}.{name}"
            frame.add(told, unit, own[name][first : first + len(frame)])
