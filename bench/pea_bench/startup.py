"""How long a command takes: to its first sample, and to its end."""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from pea_bench.plan import Plan
from pea_bench.rows import Job, Part, Row, Tick, interleaved

STARTS = re.compile(r"\[(\d+\.\d+)\].*loop starts")
"""What the plant's log says when the first sample is measured, and when (s)."""


def pea(*arguments: str, there: Path) -> None:
    """Run the command line as a user does."""
    subprocess.run(
        [sys.executable, "-m", "pea_cli.cli", *arguments],
        cwd=there,
        check=True,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )


def distributed() -> float:
    """Seconds from the command to the first sample of four processes."""
    with tempfile.TemporaryDirectory() as there:
        started = time.time()
        pea(
            *("run", "fig9_hysteresis_10hz", "--mode", "distributed", "--duration", "0.01"),
            *("--out", "run", "--json"),
            there=Path(there),
        )
        log = (Path(there) / "run/log/plant.log").read_text(errors="replace")
    found = STARTS.search(log)
    if found is None:
        raise ValueError(f"the plant's log does not say when the loop starts: {log[-200:]!r}")
    return float(found[1]) - started


def batch() -> float:
    """Seconds of the whole command for 8 s of Fig 10: 160 000 samples, recorded."""
    with tempfile.TemporaryDirectory() as there:
        started = time.perf_counter()
        pea(
            *("run", "fig10_sine_150hz", "--mode", "batch", "--duration", "8"),
            *("--out", "run", "--json"),
            there=Path(there),
        )
        return time.perf_counter() - started


def steps(plan: Plan) -> int:
    """How often `measure` tells that it goes on."""
    return 1 + 2 * plan.starts


def measure(plan: Plan, tick: Tick) -> Part:
    """Measure both commands; what is compiled once was compiled before."""
    batch()
    tick()
    jobs: dict[str, Job] = {"distributed": distributed, "batch": batch}
    found = interleaved(jobs, plan.starts, tick)
    rows = [
        Row(
            "startup.distributed_s",
            "command to first sample, four nodes and recorder",
            "s",
            found["distributed"],
            "<= 2",
        ),
        Row(
            "startup.batch_s",
            "whole command: Fig 10, 160 000 samples, recorded, with report",
            "s",
            found["batch"],
            "<= 2.5",
        ),
    ]
    return Part(rows, {}, [])
