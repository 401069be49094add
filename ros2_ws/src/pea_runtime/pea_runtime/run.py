"""One run from start to report: a directory with bag, parameters, metrics and figures."""

from __future__ import annotations

import datetime
import json
import math
import os
import platform
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pea_core import config
from pea_core.loop import LoopFault
from pea_core.params import ParameterError
from pea_core.paths import stem
from pea_runtime import frequency_response
from pea_runtime.console import err
from pea_runtime.experiments import PARAMS, Experiment
from pea_runtime.metrics import metrics, scoring, transient, truth
from pea_runtime.record import carried
from pea_runtime.record.read import Recording, load, topics

METRICS = "metrics.json"
REPORT = "report.png"
DEADLINES = "deadlines.png"
LATEST = "latest"

GATE, COUNTS = "pea: plant: gate", ("late", "missing", "overruns")
"""Diagnostic of a plant in wall time, and what it has counted."""

SOFT_START = "soft_start_s"
"""Key of the same diagnostic: longest time that its soft start takes."""


def directory(
    experiment: Experiment, out: Path | None, runs: Path = Path("runs"), prefix: str = ""
) -> Path:
    """Make the directory of a run; one that exists is never used again.

    With a `prefix` to its name it is of something else than a run, and never the latest one.

    Raises
    ------
    ParameterError
        `out` exists, or cannot be made; nothing can be named after the experiment.
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
    except OSError as error:  # of a directory of that name, for example: the run is made anyway
        draft.unlink(missing_ok=True)
        err.print(f"pea: warning: {link} does not lead to this run: {error.strerror}")


def run(
    experiment: Experiment,
    mode: str,
    out: Path,
    progress: Callable[[int], None],
    recorded: bool = True,
    **options: Any,
) -> dict[str, Any]:
    """Run an experiment in a mode, with its options, and write bag, metrics and report into `out`.

    Returns
    -------
    dict
        The metrics, as in ``metrics.json``; not `recorded`, only those that need no recording.

    Raises
    ------
    LoopFault, UnsafeCommand
        The loop could not go on; the bag holds what came before.
    """
    from pea_runtime.modes import MODES, shared_memory

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
        deadlines = MODES[mode](experiment, out, tell, **options)
        ended = time.monotonic()
    if recorded:
        figures = measure(experiment, mode, out, max(last - first, 1e-9), ended - started)
    else:
        figures = {"experiment": experiment.name, "mode": mode, "wall_s": ended - started}
    if deadlines is not None:
        figures["deadlines"] = {**deadlines.figures(), **deadlines.conditions}
        deadlines.draw(out / DEADLINES, experiment.name)
    elif options.get("wall") and recorded:
        figures["commands"] = _commands(out)
    (out / METRICS).write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
    if figures.get("safety_trip"):
        raise LoopFault(f"the safety gate has tripped: {figures['safety_trip']}")
    return figures


def measure(
    experiment: Experiment, mode: str, out: Path, loop_s: float, wall_s: float
) -> dict[str, Any]:
    """Metrics and report of a recorded run.

    Raises
    ------
    LoopFault
        Samples are missing in the recording.
    """
    recording = load(out)
    lost = _lost(recording, experiment)
    samples = recording.samples
    if lost:
        raise LoopFault(f"the recording lacks {lost} of {experiment.samples} samples: {out}")
    driven = experiment.plant()
    true = truth(driven, samples, experiment.nominal)
    plant = experiment.nodes["plant"].params
    duration = len(samples) * experiment.T_s
    begin = soft_start(out, experiment.T_ns)
    segments = experiment.segments
    said, warnings = scoring(len(samples), segments, experiment.T_s, begin)
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
        "scored": said,
        "warnings": warnings,
        **_soft_start(out),
        **metrics(samples, true, segments, plant.voltage_min, plant.voltage_max, begin),
        **transient(samples["y"] if true is None else true["x1"], experiment.move, experiment.T_s),
        "safety_trip": None if true is None else driven.trip,
        "topics": topics(recording),
        "machine": platform.platform(),
    }
    response = frequency_response.of_run(experiment, samples)
    if response:
        figures |= frequency_response.figures(response, experiment.nominal)
    from pea_runtime.report import draw, draw_response

    if response:
        draw_response(out / REPORT, experiment, figures, response)
    else:
        draw(out / REPORT, experiment, figures, samples, true, begin)
    return figures


def soft_start(out: Path, T_ns: int) -> int:
    """Samples that the soft start of a rig takes at most, as its gate has told; 0 without one."""
    return math.ceil(_soft_start(out).get(SOFT_START, 0.0) * 1e9 / T_ns - 1e-6)


def _soft_start(out: Path) -> dict[str, float]:
    """The same (s), where there is a rig."""
    values = _gate(out)
    return {SOFT_START: float(values[SOFT_START])} if SOFT_START in values else {}


def _gate(out: Path) -> dict[str, str]:
    """What the safety gate of a plant in wall time has told last."""
    from pea_runtime.record.messages import diagnostics

    told = [status for _, status in diagnostics(out) if status.name == GATE]
    return {pair.key: pair.value for pair in told[-1].values} if told else {}


def _commands(out: Path) -> dict[str, int]:
    """What a plant in wall time has counted: commands late and missing, periods overrun."""
    values = _gate(out)
    return {name: int(values[name]) for name in COUNTS if name in values}


def _lost(recording: Recording, experiment: Experiment) -> int:
    """Samples of the run that the recording lacks or has twice."""
    repeats = sum(recording.repeats.values())
    return experiment.samples - len(recording.samples) + repeats
