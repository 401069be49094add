"""What the dashboard costs, and whether it grows: the figures of docs/dashboard.md.

    .ci/env python tests/dashboard_figures.py [--rounds 6] [--seconds 5]
    .ci/env python tests/dashboard_figures.py --long 600

The first looks at one 20 kHz loop on the clock: in turn alone, beside a process that keeps the
other core busy, with a dashboard that feeds a page which draws elsewhere, and with a page open in
headless Chromium on this machine. It tells the deadlines missed in each, and how sure the ratios
are: a virtual machine misses in bursts, whatever runs on it. The last core is the loop's; all else
keeps off it.

The second leaves a page open for so many seconds while the loop runs, and tells frames a second,
the page's memory and the dashboard's, minute by minute.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from websockets.sync.client import connect

from pea_ros.discovery import stay

PEA = (sys.executable, "-m", "pea_cli.cli")
RUN = ("fig9_hysteresis_10hz", "--mode", "composed", "--clock", "wall")
CORES = frozenset(os.sched_getaffinity(0))
SETS = ("--set", "controller.preset=recommended", "--set", "observer.type=extended_state")
NOISY = ("--set", "plant.sensor.ideal=false", "--set", "plant.sensor.noise_nm=0.7")
DOMAIN, PORT = 91, 8742
FLAGS = (
    *("--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync"),
    *("--disable-background-networking", "--disable-component-update"),
    *("--enable-precise-memory-info", "--js-flags=--expose-gc", "--remote-allow-origins=*"),
)
WAYS = (
    "alone",
    "another process keeps the other core busy",
    "a page is open on another machine",
    "a page is open on this one",
)
TOLD = ("samples", "missed", "bursts")
"""What the loop counts."""

SETTLED = 2.0
"""Seconds from the start of a dashboard or a page until it counts."""


@contextlib.contextmanager
def dashboard(there: Path, *arguments: str) -> Iterator[subprocess.Popen[bytes]]:
    """A dashboard that serves its page."""
    command = [*PEA, "dashboard", *arguments, "--port", str(PORT)]
    env = {**os.environ, "ROS_DOMAIN_ID": str(DOMAIN)}
    with open(there / "dashboard.txt", "wb") as log, everywhere():
        process = subprocess.Popen(command, cwd=there, env=env, stdout=log, stderr=log)
    try:
        while True:
            with contextlib.suppress(OSError):
                urllib.request.urlopen(f"http://127.0.0.1:{PORT}/", timeout=5)
                break
            if process.poll() is not None:
                sys.exit((there / "dashboard.txt").read_text())
            time.sleep(0.1)
        yield process
    finally:
        process.send_signal(signal.SIGINT)
        process.wait(30)


@contextlib.contextmanager
def everywhere() -> Iterator[None]:
    """Let what is started meanwhile have all cores; the browser keeps off the loop's."""
    now = os.sched_getaffinity(0)
    os.sched_setaffinity(0, CORES)
    try:
        yield
    finally:
        os.sched_setaffinity(0, now)


class Page:
    """A page of it in headless Chromium, which is asked nothing but values.

    Playwright would have every frame sent to it as well, which is what is measured here.
    """

    def __init__(self, socket: Any) -> None:
        self.socket = socket

    def evaluate(self, expression: str) -> Any:
        """Value of an expression in the page."""
        asked = {"expression": expression, "returnByValue": True}
        self.socket.send(json.dumps({"id": 1, "method": "Runtime.evaluate", "params": asked}))
        return json.loads(self.socket.recv(timeout=60))["result"]["result"].get("value")


@contextlib.contextmanager
def elsewhere() -> Iterator[None]:
    """A page that draws on another machine: here, one that takes its frames and drops them."""
    with connect(f"ws://127.0.0.1:{PORT}/live", max_size=None) as socket:
        socket.send(json.dumps({"span": 1.0, "end": None}))
        taking = threading.Thread(target=lambda: [None for _ in socket], daemon=True)
        taking.start()
        yield
    taking.join()


@contextlib.contextmanager
def page(there: Path) -> Iterator[Page]:
    """Open it."""
    profile = tempfile.mkdtemp(dir=there)
    command = ["chromium", "--headless", f"--remote-debugging-port={PORT + 2}", *FLAGS]
    command += ["--window-size=1440,900", f"--user-data-dir={profile}", f"http://127.0.0.1:{PORT}/"]
    with open(there / "chromium.txt", "wb") as log:
        process = subprocess.Popen(command, stdout=log, stderr=log)
    try:
        address = ""
        while not address:
            time.sleep(0.2)
            with contextlib.suppress(OSError):
                url = f"http://127.0.0.1:{PORT + 2}/json"
                found = json.loads(urllib.request.urlopen(url, timeout=5).read())
                address = next(
                    (p["webSocketDebuggerUrl"] for p in found if p["type"] == "page"), ""
                )
        with connect(address, max_size=None) as socket:
            opened = Page(socket)
            while not opened.evaluate("Boolean(window.peaScope)"):
                time.sleep(0.2)
            yield opened
    finally:
        process.terminate()
        process.wait(30)


class Listener:
    """Hears what the loop tells of its deadlines each second: `TOLD`, so far."""

    def __init__(self) -> None:
        self.heard: list[tuple[int, ...]] = []
        rclpy.init(domain_id=DOMAIN)
        self.node = rclpy.create_node(
            "figures", enable_rosout=False, start_parameter_services=False
        )
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._hear, 10)

    def _hear(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name == "pea: loop":
                told = {pair.key: pair.value for pair in status.values}
                self.heard.append(tuple(round(float(told[name])) for name in TOLD))

    def during(self, seconds: float) -> np.ndarray:
        """`TOLD` of each second of the next so many: (n, 3) array."""
        self.heard.clear()
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            rclpy.spin_once(self.node, timeout_sec=0.1)
        return np.diff(np.array(self.heard).reshape(-1, len(TOLD)), axis=0)


@contextlib.contextmanager
def loop(there: Path) -> Iterator[None]:
    """The loop at 20 kHz on the clock, on the last core, until it is left."""
    command = [*PEA, "run", *RUN, *SETS, *NOISY, "--duration", "86400", "--cpu", str(max(CORES))]
    env = {**os.environ, "ROS_DOMAIN_ID": str(DOMAIN)}
    with open(there / "run.txt", "wb") as log, everywhere():
        process = subprocess.Popen(command, cwd=there, env=env, stdout=log, stderr=log)
    try:
        yield
    finally:
        process.send_signal(signal.SIGINT)
        process.wait(60)


@contextlib.contextmanager
def busy() -> Iterator[None]:
    """Some process that keeps the other cores busy: what no dashboard is to blame for."""
    command = [sys.executable, "-c", "while True: pass"]
    processes = [subprocess.Popen(command) for _ in CORES - {max(CORES)}]
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait()


def cost(there: Path, rounds: int, seconds: float) -> None:
    """Missed deadlines of one loop in each way, in turn; every other round backwards."""
    found: dict[str, list[np.ndarray]] = {way: [] for way in WAYS}
    frames: list[float] = []
    with loop(there):
        listener = Listener()
        while not len(listener.during(3.0)):
            pass  # it compiles
        for number in range(rounds):
            for part in (without, within)[:: -1 if number % 2 else 1]:
                part(there, listener, seconds, found, frames, backwards=bool(number % 2))
    tell(found, frames, rounds, seconds)


def without(
    there: Path, listener: Listener, seconds: float, found: Any, frames: Any, backwards: bool
) -> None:
    """Without a dashboard: alone, and beside any other work."""
    for way in WAYS[:2][:: -1 if backwards else 1]:
        with busy() if way == WAYS[1] else contextlib.nullcontext():
            found[way].append(listener.during(seconds))


def within(
    there: Path, listener: Listener, seconds: float, found: Any, frames: Any, backwards: bool
) -> None:
    """With a page of a dashboard, there and here."""
    with dashboard(there, "--attach"):
        for way in WAYS[2:][:: -1 if backwards else 1]:
            with page(there) if way == WAYS[3] else elsewhere() as opened:
                listener.during(SETTLED)
                drawn, start = opened.evaluate("peaFrames.drawn") if opened else 0, time.monotonic()
                found[way].append(listener.during(seconds))
                if opened:
                    since = time.monotonic() - start
                    frames.append((opened.evaluate("peaFrames.drawn") - drawn) / since)


def tell(found: dict[str, list[np.ndarray]], frames: list[float], rounds: int, s: float) -> None:
    """Print the table: pooled counts, and where ratios lie with 95 %, rounds drawn anew."""
    counts = {way: np.array([each.sum(axis=0) for each in found[way]]) for way in WAYS}
    chosen = np.random.default_rng(0).integers(rounds, size=(10_000, rounds))

    def share(way: str, chosen: Any) -> Any:
        samples, missed, _ = np.moveaxis(counts[way][chosen].sum(axis=-2), -1, 0)
        return np.maximum(missed, 1e-9) / samples

    def ratio(way: str, other: str) -> str:
        middle, many = (share(way, each) / share(other, each) for each in (slice(None), chosen))
        low, high = np.quantile(many, (0.025, 0.975))
        return f"{middle:.2f} ({low:.2f} to {high:.2f})"

    print(f"one loop at 20 kHz, {rounds} rounds of {s:g} s each way, in turn\n")
    print("| the loop runs | missed | of all | each second, median | halts | beside A | beside B |")
    print("|---|---|---|---|---|---|---|")
    for letter, (way, n) in zip("ABCD", counts.items(), strict=True):
        _, missed, halts = n.sum(axis=0)
        median = np.median(np.concatenate(found[way])[:, 1])
        ratios = " | ".join(ratio(way, other) for other in WAYS[:2])
        of_all = f"{share(way, slice(None)):.4%}"
        print(f"| {letter} {way} | {missed} | {of_all} | {median:g} | {halts} | {ratios} |")
    print(f"\nframes a second: {statistics.median(frames):.1f} ({min(frames):.1f} at least)")


def long(there: Path, seconds: float) -> None:
    """Frames a second and memory, minute by minute."""
    arguments = ("--run", RUN[0], "--duration", str(seconds + 60), *SETS, *NOISY)
    print("| after, s | frames a second | page's heap, MB | dashboard's memory, MB | its cores |")
    print("|---|---|---|---|---|")
    with dashboard(there, *arguments) as process:
        try:
            watch(there, process, seconds)
        finally:
            for run in runs(there):
                os.kill(run, signal.SIGINT)


def watch(there: Path, process: subprocess.Popen[bytes], seconds: float) -> None:
    """Print a row each minute."""
    known = psutil.Process(process.pid)
    with page(there) as opened:
        while not opened.evaluate("peaScope.frame.rms_nm > 0"):
            time.sleep(0.2)
        start = time.monotonic()
        drawn, at = opened.evaluate("peaFrames.drawn"), start
        used = sum(known.cpu_times()[:2])
        step = min(60.0, seconds)
        for number in range(1, round(seconds / step) + 1):
            time.sleep(max(start + number * step - time.monotonic(), 0.0))
            opened.evaluate("gc()")
            now, total = time.monotonic(), opened.evaluate("peaFrames.drawn")
            heap = opened.evaluate("performance.memory.usedJSHeapSize") / 1e6
            spent = sum(known.cpu_times()[:2])
            print(
                f"| {now - start:.0f} | {(total - drawn) / (now - at):.1f} | {heap:.1f} "
                f"| {known.memory_info().rss / 1e6:.1f} | {(spent - used) / (now - at):.2f} |",
                flush=True,
            )
            drawn, at, used = total, now, spent


def runs(there: Path) -> list[int]:
    """Process ids of the runs in a directory."""
    found = []
    for process in psutil.process_iter(["cmdline", "cwd"]):
        words = process.info["cmdline"] or []
        if "run" in words and process.info["cwd"] == str(there):
            found.append(process.pid)
    return found


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=6)
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--long", type=float, metavar="S")
    arguments = parser.parse_args()
    if not shutil.which("chromium"):
        sys.exit("needs Debian's chromium: apt install chromium")
    os.sched_setaffinity(0, CORES - {max(CORES)} or CORES)
    stay(os.environ)
    with tempfile.TemporaryDirectory() as there:
        folder = Path(there).resolve()
        if arguments.long:
            long(folder, arguments.long)
        else:
            cost(folder, arguments.rounds, arguments.seconds)


if __name__ == "__main__":
    main()
