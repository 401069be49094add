"""Memory of a long run in wall time: ``pea bench --long``."""

from __future__ import annotations

import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence

import numpy as np

from pea_bench import batch
from pea_bench.plan import Plan
from pea_bench.rows import Part, Row, Tick

TENTH = 0.1
"""Share of a run whose median is compared."""


def watch(seconds: float, tick: Tick) -> list[tuple[float, float]]:
    """Time (s) and resident memory (MiB) of ``pea run`` in wall time, each second."""
    import psutil

    found: list[tuple[float, float]] = []
    with tempfile.TemporaryDirectory() as there:
        command = [sys.executable, "-m", "pea_cli.cli", "run", batch.NAME]
        for text in batch.SETS:
            command += ["--set", text]
        command += ["--mode", "composed", "--clock", "wall", "--duration", str(seconds + 60.0)]
        process = subprocess.Popen(
            [*command, "--out", "run", "--json"],
            cwd=there,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        try:
            watched, started = psutil.Process(process.pid), time.monotonic()
            while (t := time.monotonic() - started) < seconds and process.poll() is None:
                found.append((t, watched.memory_info().rss / 2**20))
                tick()
                time.sleep(1.0)
            process.send_signal(signal.SIGINT)
            process.wait(60.0)
        finally:
            process.kill()
            process.wait()
    if found[-1][0] < seconds - 5.0:
        raise ValueError(f"the run ended after {found[-1][0]:.0f} s of {seconds:g}")
    return found


def grown(watched: Sequence[tuple[float, float]]) -> float:
    """Memory at the end to memory soon after the start: medians of a tenth of the run each."""
    values = [mib for _, mib in watched]
    tenth = max(int(TENTH * len(values)), 1)
    return float(np.median(values[-tenth:]) / np.median(values[tenth : 2 * tenth]))


def steps(plan: Plan) -> int:
    """How often `measure` tells that it goes on."""
    return round(plan.memory_s)


def measure(plan: Plan, tick: Tick) -> Part:
    """Watch the memory of one long run."""
    watched = watch(plan.memory_s, tick)
    what = f"resident at the end of {plan.memory_s:g} s : soon after its start"
    row = Row("memory.ratio", what, "", (grown(watched),), "<= 1.05")
    return Part([row], {"memory": watched}, [])
