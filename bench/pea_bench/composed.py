"""The loop in wall time, beside a loop that only keeps time, and one with an executor beside it."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any

from pea_bench import batch
from pea_bench.plan import Plan
from pea_bench.processes import figure, peers
from pea_bench.rows import Job, Part, Row, Tick, interleaved
from pea_record.read import load
from pea_ros import shared_memory
from pea_run import doctor
from pea_run.deadlines import QUANTILES, Deadlines
from pea_run.modes import composed

T_NS = 50_000


def loop(seconds: float) -> tuple[Deadlines, int]:
    """Run composed mode in wall time, recorded: its deadlines, and the samples lost."""
    made = batch.experiment(seconds)
    with tempfile.TemporaryDirectory() as there:
        out = Path(there) / "run"
        deadlines = composed.run(made, out, lambda k: None, wall=True)
        assert deadlines is not None
        recording = load(out)
        return deadlines, made.samples - len(recording.samples) + sum(recording.gaps.values())


def beside_an_executor(seconds: float) -> float:
    """Share of deadlines that a Python loop misses with an rclpy executor in another thread."""
    with peers("executor_thread", (str(seconds),)) as (process,):
        return figure(process, seconds)


def pooled(rounds: Sequence[Deadlines]) -> Deadlines:
    """All rounds as one run."""
    whole = Deadlines(T_NS)
    for each in rounds:
        whole.join(each)
    return whole


def steps(plan: Plan) -> int:
    """How often `measure` tells that it goes on."""
    return 3 * plan.wall_rounds


def measure(plan: Plan, tick: Tick) -> Part:
    """Measure the loop, the empty loop and the loop beside an executor, in turn."""
    batch.per_sample(batch.experiment(0.05), True)  # compiles
    ours: list[Deadlines] = []
    empty: list[Deadlines] = []
    losses: list[int] = []
    before = set(shared_memory.dead())

    def one() -> float:
        deadlines, missing = loop(plan.wall_s)
        ours.append(deadlines)
        losses.append(missing)
        return deadlines.missed_fraction

    def nothing() -> float:
        empty.append(doctor.measure(plan.wall_s))
        return empty[-1].missed_fraction

    jobs: dict[str, Job] = {
        "loop": one,
        "empty": nothing,
        "thread": lambda: beside_an_executor(plan.thread_s),
    }
    found = interleaved(jobs, plan.wall_rounds, tick)
    left = set(shared_memory.dead()) - before
    whole, idle = pooled(ours), pooled(empty)
    cores = tuple(each.conditions["cores"] for each in ours)
    missed, idle_missed = median(found["loop"]), median(found["empty"])
    rows = [
        Row("composed.rate_hz", "rate", "1/s", tuple(each.rate_hz for each in ours)),
        Row("composed.missed_fraction", "missed, recorded", "", found["loop"]),
        Row(
            "composed.empty_loop_missed_fraction",
            "missed by a loop that only keeps time",
            "",
            found["empty"],
        ),
        Row(
            "composed.missed_ratio_vs_empty",
            "loop : empty loop",
            "",
            (missed / idle_missed,) if idle_missed else (),
            "<= 1.5",
        ),
        Row(
            "composed.thread_missed_fraction",
            "missed by a Python loop with an executor thread",
            "",
            found["thread"],
        ),
        Row(
            "composed.thread_missed_ratio",
            "executor thread : loop",
            "",
            (median(found["thread"]) / missed,) if missed else (),
            ">= 10",
        ),
    ]
    for name, q in QUANTILES.items():
        values = tuple(each.quantile(q) / 1e3 for each in ours)
        demand = "<= 50" if name == "p999" else ""
        rows.append(Row(f"composed.lateness_us_{name}", f"lateness {name}", "us", values, demand))
    for name, rounds in (("missed", whole), ("empty_loop_missed", idle)):
        what = f"{name.replace('_', ' ')}, all rounds as one run"
        rows.append(Row(f"composed.{name}_together", what, "", (rounds.missed_fraction,)))
    rows += [
        Row("composed.lateness_us_max", "lateness, largest", "us", (whole.latest / 1e3,)),
        Row("composed.lost", "samples lost in the recording", "", (sum(losses),), "<= 0"),
        Row("composed.cores", "cores in use: loop, recording, nodes", "", cores, "<= 0.7"),
        Row("composed.shm_left", "segments left in /dev/shm", "", (len(left),), "<= 0"),
    ]
    curves: dict[str, Any] = {"lateness": {"loop": whole.tail(), "empty loop": idle.tail()}}
    return Part(rows, curves, [])
