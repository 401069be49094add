"""What recordings are worth: the tables of docs/recording.md, as Markdown.

    .ci/env python tests/recording_figures.py
    .ci/env python tests/recording_figures.py --read-back 60
    .ci/env python tests/recording_figures.py --load 60

The first breaks recordings: kills runs with SIGKILL at random moments, fills the disk, cuts files
short, changes bytes; then `pea bag check` and `recover`. Every sample that comes back is compared
with the same run left in peace.

The second records a run of so many seconds of loop time in batch mode, and another of so many
seconds on the clock; `pea bag check`; then every value is read by two libraries of other people
and compared with what `pea` reads, bit by bit.

The third says how fast `pea.load` reads so many seconds of batch mode, and what memory it takes."""

from __future__ import annotations

import argparse
import json
import os
import random
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

from pea_record.copy import recover
from pea_record.read import files_of, load
from pea_record.recording import BagError, Recording

PEA = (sys.executable, "-m", "pea_cli.cli")
RUN = (*PEA, "run", "fig9_hysteresis_10hz")
PLAIN = {**os.environ, "PEA_COMPILE": "0"}
DURATION = 0.5
KILLS, LENGTHS, FLIPS = 10, 100, 100
DISK = 1_200_000


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
        self.tries = self.refused = self.told = self.wrong = 0
        self.shares: list[float] = []
        self.lost = ""

    def add(self, path: Path, there: Path, truth: np.ndarray, share_of: int | None) -> None:
        """Recover a file; count what comes back."""
        self.tries += 1
        try:
            recording, missing = recover(path, there)
        except BagError:
            self.refused += 1
            return
        self.told += bool(missing)
        self.wrong += wrong(recording.samples, recording.stamps, truth, recording.T_ns)
        if share_of:
            self.shares.append(len(recording.samples) / share_of)

    def __str__(self) -> str:
        share = f"{min(self.shares):.1%} to {max(self.shares):.1%}" if self.shares else self.lost
        numbers = f"{self.tries} | {self.refused} | {self.told}"
        return f"| {self.what} | {numbers} | {share} | {self.wrong} |"


VICTIMS = {"run": "composed run", "clock": "composed run on the clock", "recorder": "recorder"}
OPTIONS = {
    "run": ("--mode", "composed"),
    "clock": ("--mode", "composed", "--clock", "wall"),
    "recorder": ("--mode", "distributed"),
}
"""What is killed, and options of its runs."""


def killed(row: Row, there: Path, truth: np.ndarray, victim: str) -> None:
    """Kill a run, or its recorder, at a random moment."""
    worst = 0.0
    for number in range(KILLS):
        run = there / f"{victim}{number}"
        command = (*RUN, *OPTIONS[victim], "--duration", "60", "--out", str(run))
        with subprocess.Popen(
            command,
            env=None if victim == "clock" else PLAIN,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
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


def disk_full(row: Row, there: Path, truth: np.ndarray, *options: str) -> None:
    """Let the file reach a size beyond which nothing can be written."""
    run = there / f"full-{len(list(there.iterdir()))}"

    def limit() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (DISK, DISK))

    ended = subprocess.run(
        (*RUN, *options, "--duration", "10", "--out", str(run)),
        env=PLAIN,
        preexec_fn=limit,
        capture_output=True,
        text=True,
    )
    assert ended.returncode == 3, ended
    assert ended.stderr.count("pea: ") == 1, ended.stderr
    assert "Traceback" not in ended.stderr, ended.stderr
    row.add(run, there / f"{run.name}-new", truth, None)
    size = bag_of(run).stat().st_size
    row.lost = f"all of the {size / DISK:.0%} of the disk that were written"


def rosbags(bag: Path, topic: str) -> Iterator[Any]:
    """Messages of a topic, as rosbags decodes them."""
    with AnyReader([bag]) as reader:
        chosen = [c for c in reader.connections if c.topic == topic]
        for connection, _, data in reader.messages(chosen):
            yield reader.deserialize(data, connection.msgtype)


def mcap_ros2(bag: Path, topic: str) -> Iterator[Any]:
    """Messages of a topic, as mcap-ros2-support decodes them."""
    for path in files_of(bag):
        with open(path, "rb") as file:
            reader = make_reader(file, decoder_factories=[DecoderFactory()])
            for *_, message in reader.iter_decoded_messages(topics=[topic]):
                yield message


FIELDS = ("position", "velocity", "effort")
COLUMNS = {
    "/pea/displacement": ("y", "y_dot", "u_applied"),
    "/pea/state": ("x1_hat", "x2_hat", "eps_hat"),
    "/pea/voltage": ("", "", "u"),
}


def nanoseconds(stamp: Any) -> int:
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def read_back(bag: Path, recording: Recording, library: Any) -> tuple[int, int]:
    """Samples that a library reads, and values in which it differs from what we read."""
    n, T_ns = len(recording.samples), recording.T_ns
    wrong = 0
    counts = set()
    for topic, columns in COLUMNS.items():
        found = np.full((n, len(FIELDS)), np.nan)
        stamps = np.full(n, -1)
        k = 0
        for k, message in enumerate(library(bag, topic), 1):
            if k > n:
                break
            stamps[k - 1] = nanoseconds(message.header.stamp)
            for i, field in enumerate(FIELDS):
                values = getattr(message, field)
                if len(values):
                    found[k - 1, i] = values[0]
        counts.add(k)
        wrong += int((stamps != recording.stamps).sum())
        for i, column in enumerate(columns):
            if column:
                expected = np.ascontiguousarray(recording.samples[column])
                same = np.ascontiguousarray(found[:, i]).view("<u8") == expected.view("<u8")
                wrong += int((~same).sum())
    reference = np.full((n, 3), np.nan)
    for message in library(bag, "/pea/reference"):
        start = nanoseconds(message.header.stamp)
        for point in message.points:
            k = (start + nanoseconds(point.time_from_start)) // T_ns
            if k < n:
                axes = point.positions, point.velocities, point.accelerations
                reference[k] = [values[0] for values in axes]
    for i, column in enumerate(("w", "w_dot", "w_ddot")):
        wrong += int((reference[:, i] != recording.samples[column]).sum())
    return (counts.pop() if len(counts) == 1 else -1), wrong


def table_of_libraries(there: Path, seconds: str) -> bool:
    """Print what others read; whether it is all that there is."""
    print("| run | samples | `pea bag check` | rosbags | mcap-ros2-support |")
    print("|---|---|---|---|---|")
    fine = True
    for name, options in {
        "batch": (),
        "composed, on the clock": ("--mode", "composed", "--clock", "wall"),
    }.items():
        run = there / name.split(",")[0]
        command = (*RUN, *options, "--duration", seconds, "--out", str(run))
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        told = subprocess.run(
            (*PEA, "bag", "check", str(run), "--json"), capture_output=True, text=True
        )
        check = json.loads(told.stdout)
        words = "complete" if check["complete"] else "; ".join(check["missing"])
        words += ", replays exactly" if check["replays_exactly"] else f", {check['why']}"
        recording = load(run)
        cells = []
        for library in (rosbags, mcap_ros2):
            read, wrong = read_back(run, recording, library)
            fine &= read == len(recording.samples) and wrong == 0
            cells.append(f"{read} samples, {wrong} values differ")
        fine &= told.returncode == 0
        print("|", " | ".join([name, str(check["samples"]), words, *cells]), "|", flush=True)
    return fine


LOAD = """
import resource, sys, time

import pea

begun = time.perf_counter()
run = pea.load(sys.argv[1])
n = len(run.select(*sys.argv[2:])["y"])
rate = n / (time.perf_counter() - begun) * 60e-6
memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
print(f"{n} samples | {rate:.0f} million samples a minute | {memory} MB")
"""


def loading(there: Path, seconds: str) -> None:
    """Print how fast a long run is loaded, each time in a fresh process."""
    command = (*RUN, "--duration", seconds, "--out", str(there / "run"))
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    for what, columns in {"one column": ("y",), "all columns": ()}.items():
        code = (sys.executable, "-c", LOAD, str(there / "run"), *columns)
        told = subprocess.run(code, check=True, capture_output=True, text=True).stdout
        print(f"{what} | {told}", end="", flush=True)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description="What recordings are worth.")
    parser.add_argument("--read-back", metavar="S", help="record so many seconds, read by others")
    parser.add_argument("--load", metavar="S", help="load a run of so many seconds")
    arguments = parser.parse_args()
    seconds = arguments.read_back
    if arguments.load is not None:
        with tempfile.TemporaryDirectory() as name:
            loading(Path(name), arguments.load)
        return
    if seconds is not None:
        with tempfile.TemporaryDirectory() as name:
            sys.exit(0 if table_of_libraries(Path(name), seconds) else 3)
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
        print("| what happened | times | refused | told | recovered | wrong samples |")
        print("|---|---|---|---|---|---|", flush=True)
        for victim, what in VICTIMS.items():
            row = Row(f"{what}, kill -9")
            killed(row, there, truth, victim)
            print(row, flush=True)
        for mode, options in {
            "batch": (),
            "composed on the clock": OPTIONS["clock"],
            "distributed": OPTIONS["recorder"],
        }.items():
            row = Row(f"disk full, {mode}")
            disk_full(row, there, truth, *options)
            print(row, flush=True)
        for what, count in (("file cut off", LENGTHS), ("a byte changed", FLIPS)):
            row = Row(what)
            for number in range(count):
                broken = bytearray(content)
                at = random.randrange(len(content))
                if what == "file cut off":
                    del broken[at:]
                else:
                    broken[at] ^= random.randrange(1, 256)
                path = there / f"{what.split()[-1]}-{number}.mcap"
                path.write_bytes(broken)
                row.add(path, path.with_suffix(""), truth, samples)
            print(row, flush=True)


if __name__ == "__main__":
    main()
