"""Break recordings and see what is recovered: the table of docs/recording.md.

    .ci/env python tests/recording_figures.py

Kills runs with SIGKILL at random moments, fills the disk, cuts files short, changes bytes; then
`pea bag recover`. Every sample that comes back is compared with the same run left in peace.
Prints Markdown.
"""

from __future__ import annotations

import os
import random
import resource
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from pea_runtime.record.copy import recover
from pea_runtime.record.read import BagError, load

RUN = (sys.executable, "-m", "pea_runtime.cli", "run", "fig9_hysteresis_10hz")
PLAIN = {**os.environ, "PEA_COMPILE": "0"}
DURATION = 0.5
KILLS, LENGTHS, FLIPS = 10, 100, 100
DISK = 1_000_000


def bag_of(run: Path) -> Path:
    (file,) = run.glob("*.mcap")
    return file


def wrong(found: np.ndarray, stamps: np.ndarray, truth: np.ndarray, T_ns: int) -> int:
    """Samples that are not what was recorded."""
    expected = truth[stamps // T_ns]
    return sum(a.tobytes() != b.tobytes() for a, b in zip(found, expected))


class Row:
    """One line of the table."""

    def __init__(self, what: str) -> None:
        self.what = what
        self.tries = self.refused = self.wrong = 0
        self.shares: list[float] = []
        self.lost = ""

    def add(self, path: Path, there: Path, truth: np.ndarray, share_of: int | None) -> None:
        """Recover a file; count what comes back."""
        self.tries += 1
        try:
            recording, _ = recover(path, there)
        except BagError:
            self.refused += 1
            return
        self.wrong += wrong(recording.samples, recording.stamps, truth, recording.T_ns)
        if share_of:
            self.shares.append(len(recording.samples) / share_of)

    def __str__(self) -> str:
        share = f"{min(self.shares):.1%} to {max(self.shares):.1%}" if self.shares else self.lost
        return f"| {self.what} | {self.tries} | {self.refused} | {share} | {self.wrong} |"


def killed(row: Row, there: Path, truth: np.ndarray, victim: str) -> None:
    """Kill a run, or its recorder, at a random moment."""
    worst = 0.0
    for number in range(KILLS):
        run = there / f"{victim}{number}"
        mode = "distributed" if victim == "recorder" else "composed"
        command = (*RUN, "--mode", mode, "--duration", "60", "--out", str(run))
        with subprocess.Popen(
            command, env=PLAIN, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        ) as process:
            while not any(file.stat().st_size > 60_000 for file in run.glob("*.mcap")):
                time.sleep(0.01)
            time.sleep(random.uniform(0.0, 1.5))
            pid = recorder_of(process.pid) if victim == "recorder" else process.pid
            os.kill(pid, signal.SIGKILL)
            at = time.time()
            process.send_signal(signal.SIGINT)
        worst = max(worst, at - bag_of(run).stat().st_mtime)
        row.add(run, there / f"{victim}{number}-new", truth, None)
    row.lost = f"all but the last {worst:.2f} s at most"


def recorder_of(pid: int) -> int:
    """Process id of the recorder among the children."""
    for task in Path(f"/proc/{pid}/task").glob("*/children"):
        for child in task.read_text().split():
            if b"/recorder\0" in Path(f"/proc/{child}/cmdline").read_bytes():
                return int(child)
    raise LookupError("no recorder")


def disk_full(row: Row, there: Path, truth: np.ndarray) -> None:
    """Let the file reach a size beyond which nothing can be written."""
    run = there / "full"

    def limit() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (DISK, DISK))

    ended = subprocess.run(
        (*RUN, "--duration", str(DURATION), "--out", str(run)),
        env=PLAIN,
        preexec_fn=limit,
        capture_output=True,
    )
    assert ended.returncode == 3, ended
    row.add(run, there / "full-new", truth, None)
    size = bag_of(run).stat().st_size
    row.lost = f"all of the {size / DISK:.0%} of the disk that were written"


def main() -> None:
    """Print the table."""
    random.seed(5)
    with tempfile.TemporaryDirectory() as name:
        there = Path(name)
        long = there / "long"
        subprocess.run((*RUN, "--duration", "10", "--out", str(long)), check=True, stdout=-3)
        truth = load(long).samples
        whole = there / "whole"
        subprocess.run(
            (*RUN, "--duration", str(DURATION), "--mode", "composed", "--out", str(whole)),
            env=PLAIN,
            check=True,
            stdout=-3,
        )
        content = bag_of(whole).read_bytes()
        samples = len(load(whole).samples)
        rows = [Row("composed run, kill -9"), Row("recorder, kill -9"), Row("disk full")]
        killed(rows[0], there, truth, "run")
        killed(rows[1], there, truth, "recorder")
        disk_full(rows[2], there, truth)
        for what, count in (("file cut off", LENGTHS), ("a byte changed", FLIPS)):
            rows.append(Row(what))
            for number in range(count):
                broken = bytearray(content)
                at = random.randrange(len(content))
                if what == "file cut off":
                    del broken[at:]
                else:
                    broken[at] ^= random.randrange(1, 256)
                path = there / f"{len(rows)}-{number}.mcap"
                path.write_bytes(broken)
                rows[-1].add(path, path.with_suffix(""), truth, samples)
        print("| what happened | times | refused in one line | recovered | wrong samples |")
        print("|---|---|---|---|---|")
        for row in rows:
            print(row)


if __name__ == "__main__":
    main()
