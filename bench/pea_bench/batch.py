"""Speed of the loop without ROS: one run, a sweep, and what others need for a sample."""

from __future__ import annotations

import subprocess
import tempfile
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pea_bench import hand
from pea_bench.plan import ROOT, Plan
from pea_bench.rows import Job, Part, Row, Tick, best, interleaved, ratio
from pea_core.axes import shape
from pea_core.loop import blocks_of
from pea_core.signals import SAMPLE
from pea_experiment import experiments
from pea_experiment.experiment import AnyExperiment, Experiment
from pea_lab.sweep import simulate
from pea_run.modes import batch

NAME = "fig9_hysteresis_10hz"
SETS = ("plant.sensor.ideal=false", "observer.type=extended_state")
"""Hysteresis, observer and controller: the loop that every part of the bench runs."""

MODES = "resonant"
"""Experiment of a stage of two modes, with the law and the estimator on them."""

T_S = 50e-6

PEER = ROOT / ".venv-bench/bin/python"
"""Interpreter that has opensmc."""

NEAREST = "opensmc: simulator, PID surface, no observer, no hysteresis"
MISSING = "opensmc is missing, its figures are left out: `make bench` installs it in .venv-bench"


def experiment(duration: float) -> Experiment:
    """The loop of the bench, for so long (s)."""
    return experiments.load(NAME, SETS, duration)


def per_sample(made: AnyExperiment, compiled: bool) -> float:
    """Time (us) of a sample in a new loop; the results stay in memory, in one array."""
    loop = made.loop(compiled)
    loop.run(1)  # what was compiled is loaded
    started = time.perf_counter()
    rows = np.empty(shape(made.samples, len(made.axes)), SAMPLE)
    done = 0
    for samples in blocks_of(made.samples, loop.piece):
        done += len(loop.run(samples, rows[done : done + samples]))
    return (time.perf_counter() - started) * 1e6 / done


def by_hand(made: Experiment) -> Job:
    """A job: the time (us) of a sample in the loop written by hand."""
    run, numbers, n = hand.compiled(), hand.coefficients(made), made.samples
    width = len(SAMPLE.names or ())
    run(numbers, np.zeros(1), np.empty((1, width)))  # compiles

    def job() -> float:
        plant: Any = made.plant()
        started = time.perf_counter()
        run(numbers, plant.noise(n), np.empty((n, width)))
        return (time.perf_counter() - started) * 1e6 / n

    return job


def opensmc(steps: int) -> float:
    """Time (us) of a step of opensmc's simulator, in a process of its own."""
    script = Path(__file__).parent / "peers" / "opensmc_loop.py"
    told = subprocess.run(
        [str(PEER), str(script), str(steps)],
        capture_output=True,
        text=True,
        check=True,
        stdin=subprocess.DEVNULL,
    )
    return float(told.stdout)


def sweep(plants: int, samples: int) -> float:
    """Time (us) of a sample of one plant among many, the design of each included."""
    K = np.linspace(0.13, 0.15, plants)
    started = time.perf_counter()
    simulate(NAME, {"plant.K": K}, sets=SETS, duration=samples * T_S, progress=False)
    return (time.perf_counter() - started) * 1e6 / (plants * samples)


def growth(durations: Sequence[float], tick: Tick) -> list[tuple[float, float]]:
    """Seconds of loop time, and seconds that batch mode takes with its recording."""
    found = []
    for duration in durations:
        made = experiment(duration)
        with tempfile.TemporaryDirectory() as there:
            started = time.perf_counter()
            batch.run(made, Path(there) / "run", lambda k: None)
            found.append((duration, time.perf_counter() - started))
        tick()
    return found


def steps(plan: Plan) -> int:
    """How often `measure` tells that it goes on."""
    return plan.rounds * (5 + PEER.exists()) + len(plan.durations) + len(plan.sweeps)


def measure(plan: Plan, tick: Tick) -> Part:
    """Measure one run, a sweep, plain Python, the loop by hand and opensmc."""
    short, long = experiment(plan.python_samples * T_S), experiment(plan.samples * T_S)
    modes = experiments.load(MODES, (), plan.samples * T_S)
    for made in (short, modes):
        per_sample(made, True)  # compiles
    sweep(2, plan.plant_samples)
    jobs: dict[str, Job] = {
        "one": lambda: per_sample(long, True),
        "modes": lambda: per_sample(modes, True),
        "hand": by_hand(long),
        "sweep": lambda: sweep(plan.plants, plan.plant_samples),
        "python": lambda: per_sample(short, False),
    }
    if PEER.exists():
        jobs["opensmc"] = lambda: opensmc(plan.opensmc_steps)
    found = interleaved({n: partial(best, job) for n, job in jobs.items()}, plan.rounds, tick)
    one, hand_made, many, peer = (found.get(k, ()) for k in ("one", "hand", "sweep", "opensmc"))
    rows = [
        Row("batch.us_per_step", "one run, one core", "us", one),
        Row("batch.hand_us_per_step", "the same arithmetic, by hand in numba", "us", hand_made),
        Row("batch.ratio_vs_hand", "one run : by hand", "", ratio(one, hand_made), "<= 2"),
        Row("batch.modes_us_per_step", "two modes: plant, estimator, law", "us", found["modes"]),
        Row("batch.modes_ratio", "two modes : one run", "", ratio(found["modes"], one), "<= 4"),
        Row("batch.sweep_us_per_step", f"sweep of {plan.plants}, a plant's sample", "us", many),
        Row("batch.python_us_per_step", "the same functions, plain Python", "us", found["python"]),
        Row("batch.opensmc_us_per_step", NEAREST, "us", peer),
        Row("batch.ratio_vs_opensmc", "opensmc : one run", "", ratio(peer, one), ">= 100"),
        Row("batch.sweep_ratio_vs_opensmc", "opensmc : sweep", "", ratio(peer, many), ">= 500"),
    ]
    curves: dict[str, Any] = {"duration": growth(plan.durations, tick), "plants": []}
    for plants in plan.sweeps:
        curves["plants"].append((plants, sweep(plants, plan.plant_samples)))
        tick()
    return Part(rows, curves, [] if PEER.exists() else [MISSING])
