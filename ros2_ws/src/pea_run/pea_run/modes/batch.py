"""One process, no ROS, as fast as the machine goes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from pea_core.config import BATCH
from pea_core.loop import blocks_of
from pea_engine.compiled import wanted
from pea_experiment.experiment import AnyExperiment
from pea_record.bag import WHOLE, Split
from pea_record.origin import ORIGIN, origin
from pea_record.rows import NOTHING, Trip, ahead, record
from pea_record.trigger import Trigger, opened
from pea_run.modes.detector import signal_of


def run(
    experiment: AnyExperiment,
    out: Path,
    progress: Callable[[int], None],
    split: Split = WHOLE,
    trigger: Trigger | None = None,
) -> None:
    """Run an experiment and record it in `out`, or the windows of a trigger.

    Raises
    ------
    LoopFault
        The loop cannot go on; what came before is recorded.
    """
    loop = experiment.loop(wanted(experiment.samples))
    T_ns = experiment.T_ns
    with opened(out, T_ns, split, trigger, experiment.scan_events) as bag:
        bag.metadata(ORIGIN, origin(experiment.name, experiment.sections(), BATCH, T_ns))
        trip, detect = Trip(bag, loop.plant), signal_of(experiment)
        for samples in blocks_of(experiment.samples, loop.piece):
            k, done = loop.k, 0
            rows = loop.run(samples)
            for part in blocks_of(len(rows)):
                last = loop.k == k + done + part
                ends = last and (loop.fault or loop.k == experiment.samples)
                after = ahead(loop) if ends else NOTHING
                piece = rows[done : done + part]
                found = (experiment.axes, experiment.scan_events, detect(piece))
                record(bag, k + done, T_ns, piece, after, *found)
                done += part
            trip.look()
            progress(loop.k)
            if loop.fault:
                raise loop.fault
