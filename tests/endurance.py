"""An hour of the loop: complete, replays, flat in memory.

    .ci/env python tests/endurance.py [--seconds 3600] [composed] [rig]

``composed`` runs `sine_series` at 20 kHz in wall time in one process; ``rig`` runs
`fig9_hysteresis_10hz` at 1 Hz on the emulated E-727 at 200 Hz. Both are recorded. Afterwards
`pea bag check` looks whether the bag is complete, and `pea replay` runs the blocks again. Memory is
what the process and its children keep for themselves, once a minute; what the run's end, the check
and the replay take at most is told besides. Ends with status 1 where a sample is lost, a bit
differs, memory grew by more than 5 % after the first five minutes (after a sixth of a shorter run),
or a process took more than 1.5 GB.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import psutil

PEA = (sys.executable, "-m", "pea_cli.cli")
RIG = "e727_200hz_emulated"
GROWTH = 1.05
MOST = 1500.0
"""Megabytes that a process may take, to read a recording back too."""

RUNS = {
    "composed": ("sine_series", "--mode", "composed", "--clock", "wall"),
    "rig": ("fig9_hysteresis_10hz", "--rig", RIG, "--set", "reference.frequency_hz=1"),
}


def memory(process: psutil.Process) -> float:
    """Megabytes that a process and its children have for themselves.

    Pages of files are left out: who else has them in memory changes with every other program.
    """
    total = 0
    for each in (process, *process.children(recursive=True)):
        try:
            held = each.memory_info()
        except psutil.Error:
            continue
        total += held.rss - held.shared
    return total / 1e6


def most() -> float:
    """Megabytes that the largest process so far has taken, pages of files included."""
    return resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1e3


def endure(name: str, seconds: float, out: Path) -> bool:
    """One run; whether it held."""
    command = [*PEA, "run", *RUNS[name], "--duration", f"{seconds:g}", "--out", str(out), "--json"]
    watched: list[tuple[float, float]] = []
    with open(out.with_suffix(".json"), "wb") as told, open(out.with_suffix(".log"), "wb") as log:
        run = subprocess.Popen(command, stdout=told, stderr=log)
        began = time.monotonic()
        process = psutil.Process(run.pid)
        while run.poll() is None:
            after = time.monotonic() - began
            if after < seconds:  # what follows reads the recording back
                watched.append((after, memory(process)))
                print(f"{name}: {after:5.0f} s {watched[-1][1]:7.1f} MB", flush=True)
            try:
                run.wait(min(60.0, seconds / 12.0))
            except subprocess.TimeoutExpired:
                continue
    if run.returncode:
        print(f"{name}: ended with status {run.returncode}: {out.with_suffix('.log').read_text()}")
        return False
    figures = json.loads(out.with_suffix(".json").read_text())
    settled = [m for t, m in watched if t >= min(300.0, seconds / 6.0)]
    grown = max(settled[-3:]) / max(settled[:2]) if settled else float("nan")
    print(f"{name}: {figures['samples']} samples, {figures['lost_samples']} lost, grew {grown:.3f}")
    print(f"{name}: {figures.get('deadlines') or figures.get('commands')}")
    print(f"{name}: at most {most():.0f} MB, its end included", flush=True)
    held = figures["lost_samples"] == 0 and grown <= GROWTH
    for check in (["bag", "check", str(out)], ["replay", str(out)]):
        done = subprocess.run([*PEA, *check], capture_output=True, text=True)
        print(f"{name}: pea {check[0]}: {done.stdout.strip() or done.stderr.strip()}")
        held &= done.returncode == 0
    print(f"{name}: at most {most():.0f} MB", flush=True)
    return held and most() <= MOST


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("names", nargs="*", choices=[*RUNS, []], help="runs, all by default")
    parser.add_argument("--seconds", type=float, default=3600.0)
    parser.add_argument("--keep", type=Path, help="directory for what is recorded")
    options = parser.parse_args()
    names = options.names or list(RUNS)
    with tempfile.TemporaryDirectory(dir=options.keep or "/var/tmp") as there:
        emulator = None
        if "rig" in names:
            emulator = subprocess.Popen(
                [*PEA, "emulate", "gcs", "--rig", RIG], stdout=subprocess.PIPE, text=True
            )
            assert emulator.stdout is not None
            print(f"emulator at {emulator.stdout.readline().strip()}")  # it listens from here on
        try:
            held = [endure(name, options.seconds, Path(there) / name) for name in names]
        finally:
            if emulator is not None:
                emulator.send_signal(signal.SIGINT)
                emulator.wait(10.0)
    return 0 if all(held) else 1


if __name__ == "__main__":
    os.environ.setdefault("PYTHONUNBUFFERED", "1")
    sys.exit(main())
