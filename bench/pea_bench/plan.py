"""How long the bench takes: sizes of its measurements."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[2]
"""The checkout: the bench keeps its figures there, and the peer's virtual environment."""


class Plan(NamedTuple):
    """Sizes.

    Attributes
    ----------
    rounds : int
        Interleaved rounds of what takes a moment.
    samples, python_samples, opensmc_steps : int
        Samples of one run: compiled, plain Python, the peer's.
    plants, plant_samples : int
        Plants of a sweep, samples of each.
    wall_rounds : int
        Rounds in wall time, of composed loop and empty loop.
    wall_s, thread_s : float
        Length of each (s), and of the loop with an executor beside it.
    device_rounds : int
        Rounds of the loops on emulated devices.
    device_s : float
        Length of each (s).
    ring_rounds : int
        Rounds of the rings.
    ring_s : float
        Length of a ring's run (s).
    loop_samples : int
        Samples of a distributed run.
    messages, naive_messages : int
        Messages recorded as fast as it goes, by each path.
    paced_s : float
        Length of the recording in wall time (s).
    starts : int
        Rounds of commands timed from start to end.
    axes : tuple of int
        How many distributed loops run at once, where growth is drawn.
    stages : tuple of int
        Axes of the stages that are measured beside one axis.
    durations : tuple of float
        Lengths of the runs whose growth is drawn (s).
    sweeps : tuple of int
        Numbers of plants likewise.
    memory_s : float
        Length of the run whose memory is watched (s).
    """

    rounds: int = 5
    samples: int = 160_000
    python_samples: int = 4000
    opensmc_steps: int = 3000
    plants: int = 1000
    plant_samples: int = 20_000
    wall_rounds: int = 20
    wall_s: float = 3.0
    thread_s: float = 4.0
    device_rounds: int = 5
    device_s: float = 5.0
    ring_rounds: int = 3
    ring_s: float = 3.0
    loop_samples: int = 60_000
    messages: int = 400_000
    naive_messages: int = 8000
    paced_s: float = 10.0
    starts: int = 3
    axes: tuple[int, ...] = (1, 2, 4)
    stages: tuple[int, ...] = (2, 3, 6)
    durations: tuple[float, ...] = (0.5, 2.0, 8.0, 32.0)
    sweeps: tuple[int, ...] = (1, 4, 16, 64, 256, 1024)
    memory_s: float = 600.0


USUAL = Plan()

QUICK = Plan(
    rounds=3,
    samples=40_000,
    python_samples=1000,
    opensmc_steps=1000,
    plants=64,
    plant_samples=2000,
    wall_rounds=2,
    wall_s=2.0,
    thread_s=2.0,
    device_rounds=1,
    device_s=2.0,
    ring_rounds=1,
    ring_s=1.5,
    loop_samples=20_000,  # as few as are compiled
    messages=80_000,
    naive_messages=2000,
    paced_s=2.0,
    starts=1,
    axes=(1, 2),
    stages=(2,),
    durations=(0.5, 2.0),
    sweeps=(1, 16, 64),
)
