"""A measurement carried out: run, recorded, analysed, drawn."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pea_core.loop import LoopFault
from pea_core.params import ParameterError
from pea_lab.check import refuse
from pea_measure import analysis
from pea_measure.plans import PlannedMeasurement
from pea_record.read import load
from pea_run.run import directory, run

RESULT, PICTURE = "measurement.json", "measurement.png"
"""Files that a measurement leaves beside its recording."""


def carry_out(
    measurement: PlannedMeasurement,
    mode: str,
    out: Path | None,
    progress: Callable[[int], None],
    **options: Any,
) -> tuple[Path, dict[str, Any]]:
    """Run a measurement in a mode and analyse it; its directory and its figures.

    Raises
    ------
    ParameterError
        A loop that is unstable in theory, a directory that exists.
    LoopFault, UnsafeCommand
        The loop could not go on; the bag holds what came before.
    """
    experiment = measurement.experiment
    if not measurement.settings["open"]:
        refuse(experiment)
    there = directory(experiment, out, prefix="" if out else f"measure-{measurement.kind}-")
    run(experiment, mode, there, progress, **options)
    return there, analysed(measurement, there)


def analysed(measurement: PlannedMeasurement, there: Path) -> dict[str, Any]:
    """Figures of a measurement that is recorded in a directory; written and drawn there.

    Raises
    ------
    LoopFault
        The recording is too short.
    """
    recording = load(there)
    samples, lost = analysis.by_stamps(
        recording.samples, recording.stamps, measurement.experiment.T_ns
    )
    try:
        found = {**analysis.of(measurement, samples), "samples_not_recorded": lost}
    except ParameterError as error:
        raise LoopFault(f"{there}: {error}") from None
    found["run"] = str(there)
    (there / RESULT).write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    analysis.draw(there / PICTURE, measurement, found, samples)
    return found
