"""What further axes cost: a stage of two beside one axis, in each mode, in the same run."""

from __future__ import annotations

import tempfile
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

from pea_bench import batch, composed
from pea_bench.distributed import steady_loop, transport
from pea_bench.plan import Plan
from pea_bench.rows import Job, Part, Row, Tick, best, interleaved, ratio
from pea_experiment import experiments
from pea_experiment.experiment import AnyExperiment
from pea_run.deadlines import Deadlines
from pea_run.modes import composed as in_one_process

NAMES = ("x", "y", "z", "tip", "tilt", "piston")


def experiment(axes: int, duration: float) -> AnyExperiment:
    """The loop of the bench for each of some axes, nothing between them."""
    sets = [*batch.SETS, f"axes=[{', '.join(NAMES[:axes])}]"]
    return experiments.load_axes(batch.NAME, sets, duration)


def in_wall_time(axes: int, seconds: float, told: list[Deadlines]) -> float:
    """Share of deadlines that a recorded loop misses."""
    with tempfile.TemporaryDirectory() as there:
        made = experiment(axes, seconds)
        deadlines = in_one_process.run(made, Path(there) / "run", lambda k: None, wall=True)
    assert deadlines is not None
    told.append(deadlines)
    return deadlines.missed_fraction


def in_lock_step(axes: int, samples: int) -> float:
    """Recorded samples a second of four nodes."""
    with transport("turbo"):
        return steady_loop(experiment(axes, samples * batch.T_S))


def steps(plan: Plan) -> int:
    """How often `measure` tells that it goes on."""
    return plan.rounds * (1 + len(plan.stages)) + 2 * plan.wall_rounds + 2 * plan.ring_rounds


def measure(plan: Plan, tick: Tick) -> Part:
    """Measure a step, the deadlines and the lock-step of one axis and of several, in turn."""
    counts = (1, *plan.stages)
    made = {axes: experiment(axes, plan.samples * batch.T_S) for axes in counts}
    for axes in counts:
        batch.per_sample(experiment(axes, 0.01), True)  # compiles
    jobs: dict[str, Job] = {
        str(axes): partial(best, partial(batch.per_sample, made[axes], True)) for axes in counts
    }
    found = interleaved(jobs, plan.rounds, tick)
    rows = [Row("axes.us_per_step", "a step of one axis", "us", found["1"])]
    for axes in plan.stages:
        demand = "<= 2.2" if axes == 2 else ""
        values = ratio(found[str(axes)], found["1"])
        rows.append(Row(f"axes.ratio_{axes}", f"{axes} axes : one, batch", "", values, demand))
    told: dict[int, list[Deadlines]] = {1: [], 2: []}
    walls: dict[str, Job] = {
        str(axes): partial(in_wall_time, axes, plan.wall_s, told[axes]) for axes in told
    }
    missed = interleaved(walls, plan.wall_rounds, tick)
    one, two = (composed.pooled(told[axes]) for axes in (1, 2))
    many = (median(missed["2"]) / median(missed["1"]),) if median(missed["1"]) else ()
    rows += [
        Row("axes.missed_fraction", "missed of one axis, composed, wall time", "", missed["1"]),
        Row("axes.missed_fraction_2", "missed of two axes", "", missed["2"]),
        Row("axes.missed_ratio", "two axes : one, median of rounds", "", many, "<= 1.2"),
        Row(
            "axes.missed_together",
            "two axes : one, all rounds as one run",
            "",
            (two.missed_fraction / one.missed_fraction,) if one.missed_fraction else (),
        ),
    ]
    locked: dict[str, Job] = {
        str(axes): partial(in_lock_step, axes, plan.loop_samples) for axes in (1, 2)
    }
    speed = interleaved(locked, plan.ring_rounds, tick)
    rows += [
        Row("axes.lock_step_per_s", "distributed, one axis", "1/s", speed["1"]),
        Row(
            "axes.lock_step_ratio",
            "two axes : one, distributed",
            "",
            ratio(speed["2"], speed["1"]),
            ">= 0.8",
        ),
    ]
    curves: dict[str, Any] = {"lateness": {"one axis": one.tail(), "two axes": two.tail()}}
    return Part(rows, curves, [])
