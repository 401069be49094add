"""One run from start to report: a directory with bag, parameters, metrics and figures."""

from __future__ import annotations

import datetime
import json
import os
import platform
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pea_core import config
from pea_core.axes import one_axis
from pea_core.console import err
from pea_core.loop import LoopFault
from pea_core.params import ParameterError
from pea_core.paths import stem
from pea_experiment.experiment import AnyExperiment, Experiment, MultiAxis
from pea_experiment.experiments import PARAMS, shortened
from pea_experiment.metrics import together, truth
from pea_experiment.scoring import scoring, unsettled
from pea_lab import frequency_response
from pea_record import carried
from pea_record.read import load_axes, topics
from pea_record.recording import BagError, Recording
from pea_record.trigger import kept, windows
from pea_report.folder import (
    DEADLINES,
    METRICS,
    REPORT,
    SOFT_START,
    commands,
    gate,
    soft_start,
)

if TYPE_CHECKING:
    from pea_lab.frequency_response import Response
    from pea_run.deadlines import Deadlines

LATEST = "latest"

SCORE = "PEA_SCORE"
"""Environment variable; 0: an interrupted run is not scored, and ends at once."""


LATE = 0.05
"""Share of late or missing commands and overrun periods above which a run warns."""


def directory(
    experiment: AnyExperiment, out: Path | None, runs: Path = Path("runs"), prefix: str = ""
) -> Path:
    """Make the directory of a run; an existing one is never used again.

    A directory with a `prefix` is not that of a run, so `LATEST` does not point to it.

    Raises
    ------
    ParameterError
        `out` exists, or cannot be made, or the experiment's name is no valid file name.
    """
    name = stem(experiment.name, "experiment.name")
    try:
        if out is not None:
            str(out).encode()
            out.mkdir(parents=True)
            return out
        if runs.is_symlink() and not runs.exists():
            raise ParameterError(
                f"{runs}: leads to {os.readlink(runs)}, which is not there; make it, or remove "
                "the link"
            )
        stamp = datetime.datetime.now().strftime("%Y%m%d-%H%M%S")
        for copy in range(1000):
            path = runs / f"{prefix}{name}-{stamp}{f'-{copy}' if copy else ''}"
            try:
                path.mkdir(parents=True)
            except FileExistsError:
                continue
            if not prefix:
                _point(runs / LATEST, path.name)
            return path
        raise ParameterError(f"{runs}: a thousand runs in one second")
    except FileExistsError:
        raise ParameterError(
            f"--out {out}: exists already; a run never overwrites, name a new directory"
        ) from None
    except UnicodeEncodeError:
        raise ParameterError(f"--out {str(out)!r}: must be UTF-8") from None
    except OSError as error:
        raise ParameterError(f"{out or runs}: {error.strerror}") from None


def _point(link: Path, target: str) -> None:
    draft = link.with_name(f".{link.name}-{os.getpid()}")
    try:
        draft.symlink_to(target)
        draft.replace(link)
    except OSError as error:  # for example, a directory has that name: the run goes on
        draft.unlink(missing_ok=True)
        err.print(f"pea: warning: {link} does not lead to this run: {error.strerror}")


def run(
    experiment: AnyExperiment,
    mode: str,
    out: Path,
    progress: Callable[[int], None],
    recorded: bool = True,
    drawn: bool = True,
    **options: object,
) -> dict[str, Any]:
    """Run an experiment in a mode, with its options, and write bag, metrics and report into `out`.

    Parameters
    ----------
    experiment : Experiment or MultiAxis
    mode : str
        Of `MODES`.
    out : Path
        Directory of the run.
    progress : callable
        Called with the number of samples that are done.
    recorded : bool
        Whether to write a bag.
    drawn : bool
        Whether to draw figures: ``report.png``, and ``deadlines.png`` of a loop in wall time.
    **options
        Options of the mode.

    Returns
    -------
    dict
        The metrics, as in ``metrics.json``; without a bag, only those that need no recording.

    Raises
    ------
    LoopFault, UnsafeCommand
        The loop could not go on; the bag holds the samples before.
    KeyboardInterrupt
        The run was interrupted; the metrics of the recorded part are written.
    """
    from pea_ros import shared_memory
    from pea_run.modes import MODES

    config.write(out / PARAMS, carried.beside(out, experiment.sections()))
    first = last = time.monotonic()

    def tell(samples: int) -> None:
        nonlocal first, last
        last = time.monotonic()
        if samples <= 0:
            first = last
        progress(samples)

    if not recorded:
        options["recorded"] = False
    with shared_memory.swept():
        started = first = last = time.monotonic()
        deadlines, interrupted = None, None
        try:
            deadlines = MODES[mode](experiment, out, tell, **options)
        except KeyboardInterrupt as error:
            interrupted, whole = error, experiment.samples
            if not options.get("trigger"):
                experiment = _interrupted(experiment, out, recorded)
        ended = time.monotonic()
    if options.get("trigger"):
        figures = windowed(experiment, mode, out, ended - started)
    elif recorded:
        figures = measure(experiment, mode, out, max(last - first, 1e-9), ended - started, drawn)
        if deadlines is None and options.get("wall"):
            figures["commands"] = commands(out)
    else:
        figures = {"experiment": experiment.name, "mode": mode, "wall_s": ended - started}
    if deadlines is not None:
        figures |= _kept(deadlines, SOFT_START in figures)
        if drawn:
            deadlines.draw(out / DEADLINES, experiment.name)
    before, after = [], [held_up(figures)] if recorded else []
    if interrupted is not None:
        part = f" after {experiment.samples} of {whole} samples"
        before = ["interrupted" + ("" if options.get("trigger") else part)]
    if said := [*filter(None, (*before, *figures.get("warnings", ()), *after))]:
        figures["warnings"] = said
    (out / METRICS).write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
    if interrupted is not None:
        raise interrupted
    if figures.get("safety_trip"):
        raise LoopFault(f"the safety gate has tripped: {figures['safety_trip']}")
    return figures


def _kept(deadlines: Deadlines, device: bool) -> dict[str, Any]:
    """Figures of the deadlines of this process; with a `device`, also those of its commands."""
    figures: dict[str, Any] = {"deadlines": {**deadlines.figures(), **deadlines.conditions}}
    if device:  # no command comes from another process, so none is late
        figures["commands"] = {"late": 0, "missing": 0, "overruns": deadlines.missed}
    return figures


def _interrupted(experiment: AnyExperiment, out: Path, recorded: bool) -> AnyExperiment:
    """The part of an experiment that an interrupted run has recorded.

    Raises
    ------
    KeyboardInterrupt
        Nothing was recorded, or it shall not be scored.
    """
    try:
        scored = recorded and os.environ.get(SCORE) != "0"
        samples = len(load_axes(out).samples) if scored else 0
    except BagError:
        samples = 0
    if not samples:
        raise KeyboardInterrupt
    return shortened(experiment, samples)


def windowed(experiment: AnyExperiment, mode: str, out: Path, wall_s: float) -> dict[str, Any]:
    """Metrics of a triggered recording; its windows cannot be scored."""
    metadata, trip = kept(out)
    figures: dict[str, Any] = {
        "experiment": experiment.name,
        "mode": mode,
        "wall_s": wall_s,
        "windows": len(windows(metadata)),
        "safety_trip": trip,
    }
    if not figures["windows"]:
        figures["warnings"] = ["the trigger has not fired: the recording holds no sample"]
    return figures


def held_up(figures: Mapping[str, Any]) -> str:
    """A warning if so many commands were late that the score is not valid; else empty."""
    counts, samples = figures.get("commands", {}), figures.get("samples", 0)
    late = sum(counts.values())
    if late <= LATE * samples:
        return ""
    words = ", ".join(f"{count} {name}" for name, count in counts.items() if count)
    return (
        f"of {samples} samples {words}: the stage did not get the commands in time, so the score "
        "is not that of this loop; take a longer T_s or a less loaded machine, see pea doctor"
    )


def measure(
    experiment: AnyExperiment, mode: str, out: Path, loop_s: float, wall_s: float, drawn: bool
) -> dict[str, Any]:
    """Metrics of a recorded run; if `drawn`, also its report.

    Raises
    ------
    LoopFault
        Samples are missing in the recording.
    """
    recording = load_axes(out)
    lost = _lost(recording, experiment)
    samples = recording.samples
    if lost:
        raise LoopFault(f"the recording lacks {lost} of {experiment.samples} samples: {out}")
    driven = experiment.plant()
    each = experiment.each
    nominal = tuple(one.nominal for one in each)
    true = truth(driven, samples, nominal if len(each) > 1 else nominal[0])
    duration = len(samples) * experiment.T_s
    told = gate(out, recording)
    begin = soft_start(told, experiment.T_ns)
    said, warnings, by_axis = [], [], {}
    for i, one in enumerate(each):
        own, own_true = one_axis(samples, i), None if true is None else one_axis(true, i)
        scored, warned = scoring(len(own), one.segments, one.T_s, begin)
        said.append(scored)
        by_axis[one.axis] = one.figures(own, own_true, begin)
        moved = own["y"] if own_true is None else own_true["x1"]
        warnings += warned + unsettled(by_axis[one.axis], moved, one.move, one.T_s)
    figures: dict[str, Any] = {
        "experiment": experiment.name,
        "mode": mode,
        "samples": len(samples),
        "lost_samples": lost,
        "sample_period_ns": experiment.T_ns,
        "duration_s": duration,
        "wall_s": wall_s,
        "loop_s": loop_s,
        "real_time_factor": duration / loop_s,
        "samples_per_s": len(samples) / loop_s,
        "scored": _joined(experiment.axes, said),
        "warnings": list(dict.fromkeys(warnings)),
        **{key: float(told[key]) for key in (SOFT_START,) if key in told},
        **(by_axis[each[0].axis] if len(each) == 1 else together(by_axis, samples)),
        "safety_trip": None if true is None else driven.trip,
        "topics": topics(recording),
        "machine": platform.platform(),
    }
    response = None
    if isinstance(experiment, Experiment):
        response = frequency_response.of_run(experiment, samples)
        if response:
            figures |= frequency_response.figures(response, experiment.nominal)
    if drawn:
        _report(out / REPORT, experiment, figures, samples, true, begin, response)
    return figures


def _report(
    path: Path,
    experiment: AnyExperiment,
    figures: dict[str, Any],
    samples: np.ndarray,
    true: np.ndarray | None,
    begin: int,
    response: Response | None,
) -> None:
    """Draw the report; for a run that measures a frequency response, draw the response."""
    from pea_report.axes import draw_axes
    from pea_report.figures import draw, draw_response

    if isinstance(experiment, MultiAxis):
        draw_axes(path, experiment, figures, samples, true, begin)
    elif response:
        draw_response(path, experiment, figures, response)
    else:
        draw(path, experiment, figures, samples, true, begin)


def _joined(axes: Sequence[str], said: Sequence[str]) -> str:
    """What is scored, in words; one text if it is the same for every axis."""
    if len(set(said)) == 1:
        return said[0]
    return "; ".join(f"{axis}: {text}" for axis, text in zip(axes, said, strict=True))


def _lost(recording: Recording, experiment: AnyExperiment) -> int:
    """Samples of the run that the recording lacks or has twice."""
    repeats = sum(recording.repeats.values())
    return experiment.samples - len(recording.samples) + repeats
