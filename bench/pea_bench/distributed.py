"""Samples a second of four nodes in lock-step, beside a naive ring and a ring of pipes."""

from __future__ import annotations

import contextlib
import os
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from statistics import mean

from pea_bench import batch
from pea_bench.plan import Plan
from pea_bench.processes import figure, peers
from pea_bench.rows import Job, Part, Row, Tick, interleaved, ratio
from pea_core import config
from pea_experiment.experiment import AnyExperiment
from pea_experiment.experiments import PARAMS
from pea_ros.paths import SWITCH as TRANSPORT
from pea_run.modes import distributed

STEADY = 0.2
"""Share of the samples after which a run counts as steady."""


@contextlib.contextmanager
def transport(name: str) -> Iterator[None]:
    """Have the nodes take one way, each loop in a ROS domain of its own."""
    usual = {each: os.environ.pop(each, None) for each in (TRANSPORT, "ROS_DOMAIN_ID")}
    os.environ[TRANSPORT] = name
    try:
        yield
    finally:
        del os.environ[TRANSPORT]
        os.environ.update({each: value for each, value in usual.items() if value is not None})


def steady(told: list[tuple[float, int]]) -> float:
    """Samples a second once a run is under way.

    Parameters
    ----------
    told : list of (float, int)
        When (s) how many samples were recorded.
    """
    t_1, k_1 = told[-1]
    t_0, k_0 = next((t, k) for t, k in told if k >= STEADY * k_1)
    return (k_1 - k_0) / (t_1 - t_0) if t_1 > t_0 else k_1 / (t_1 - told[0][0])


def loop(samples: int) -> float:
    """Recorded samples a second of our nodes."""
    return steady_loop(batch.experiment(samples * batch.T_S))


def steady_loop(made: AnyExperiment) -> float:
    """The same of an experiment."""
    told: list[tuple[float, int]] = []
    with tempfile.TemporaryDirectory() as there:
        config.write(Path(there) / PARAMS, made.sections())
        distributed.run(made, Path(there), lambda k: told.append((time.monotonic(), k)))
    return steady(told)


def nodes(way: str, samples: int) -> float:
    """The same, by one of the ways."""
    with transport(way):
        return loop(samples)


def axes(count: int, samples: int, way: str = "turbo") -> float:
    """Recorded samples a second of each of several axes: loops of their own, all at once."""
    with transport(way), ThreadPoolExecutor(count) as pool:
        return mean(pool.map(loop, [samples] * count))


def naive(seconds: float) -> float:
    """Loops a second of three rclpy nodes with an executor each."""
    with peers("ring", *((str(role), str(seconds)) for role in range(3))) as ring:
        return figure(ring[0], seconds)


def fast_ring(seconds: float) -> float:
    """The same by the nodes' fast way, on their core."""
    ends = str(seconds), str(distributed.core())
    with peers("fast_ring", *((str(role), *ends) for role in range(3))) as ring:
        return figure(ring[0], seconds)


def pipes(seconds: float) -> float:
    """Loops a second of three processes with pipes between them."""
    with peers("pipe_ring", (str(seconds),)) as (ring,):
        return figure(ring, seconds)


def steps(plan: Plan) -> int:
    """How often `measure` tells that it goes on."""
    return 5 * plan.ring_rounds + len(plan.axes)


def measure(plan: Plan, tick: Tick) -> Part:
    """Measure our nodes, the naive ring and the ring of pipes."""
    jobs: dict[str, Job] = {
        "turbo": lambda: nodes("turbo", plan.loop_samples),
        "fast": lambda: nodes("fast", plan.loop_samples),
        "fast ring": lambda: fast_ring(plan.ring_s),
        "naive": lambda: naive(plan.ring_s),
        "pipes": lambda: pipes(min(plan.ring_s, 1.0)),
    }
    found = interleaved(jobs, plan.ring_rounds, tick)
    turbo, fast, plain = found["turbo"], found["fast"], found["naive"]
    bare = found["fast ring"]
    rows = [
        Row("distributed.samples_per_s", "turbo, recorded", "1/s", turbo),
        Row("distributed.fast_samples_per_s", "fast, recorded", "1/s", fast),
        Row(
            "distributed.fast_ring_per_s", "the fast way, nothing computed or recorded", "1/s", bare
        ),
        Row(
            "distributed.naive_rclpy_samples_per_s",
            "naive rclpy ring, three nodes that compute and record nothing",
            "1/s",
            plain,
        ),
        Row("distributed.ratio_vs_naive", "turbo : naive", "", ratio(turbo, plain), ">= 10"),
        Row("distributed.fast_ratio_vs_naive", "fast : naive", "", ratio(fast, plain), ">= 6"),
        Row("distributed.fast_ring_ratio", "fast ring : naive", "", ratio(bare, plain), ">= 6"),
        Row("distributed.pipe_ring_samples_per_s", "pipes, one core", "1/s", found["pipes"]),
    ]
    each = []
    for count in plan.axes:
        each.append((count, axes(count, plan.loop_samples)))
        tick()
    return Part(rows, {"axes": each}, [])
