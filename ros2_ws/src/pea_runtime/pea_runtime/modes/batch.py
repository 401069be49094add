"""One process, no ROS, as fast as the machine goes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from pea_core.compiled import wanted
from pea_core.loop import blocks_of
from pea_runtime.experiments import Experiment
from pea_runtime.record.bag import BagWriter
from pea_runtime.record.rows import record


def run(experiment: Experiment, out: Path, progress: Callable[[int], None]) -> None:
    """Run an experiment and record it in `out`.

    Raises
    ------
    LoopFault
        The loop cannot go on; what came before is recorded.
    """
    loop = experiment.loop(wanted(experiment.samples))
    with BagWriter(out) as bag:
        for samples in blocks_of(experiment.samples):
            k = loop.k
            record(bag, k, experiment.T_ns, loop.run(samples))
            progress(loop.k)
            if loop.fault:
                raise loop.fault
