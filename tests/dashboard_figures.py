"""What the dashboard costs, and whether it grows: the figures of docs/dashboard.md.

    .ci/env python tests/dashboard_figures.py [--rounds 5] [--seconds 10]
    .ci/env python tests/dashboard_figures.py --long 600

The first runs the 20 kHz loop on the clock, in turn alone, with a dashboard that listens, and with
a page of it open in headless Chromium on this machine, and tells the deadlines missed. The last
core is the loop's; dashboard and browser keep off it.

The second leaves a page open for so many seconds while the loop runs, and tells frames a second,
the page's memory and the dashboard's, minute by minute.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
from websockets.sync.client import connect

PEA = (sys.executable, "-m", "pea_runtime.cli")
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
WAYS = ("alone", "a dashboard listens", "a page is open")


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


def deadlines(there: Path, seconds: float) -> dict[str, Any]:
    """One run; how its deadlines were kept."""
    command = [*PEA, "run", *RUN, *SETS, *NOISY, "--duration", str(seconds), "--json"]
    command += ["--cpu", str(max(CORES))]
    env = {**os.environ, "ROS_DOMAIN_ID": str(DOMAIN)}
    with everywhere():
        done = subprocess.run(
            command, cwd=there, env=env, capture_output=True, text=True, check=True
        )
    figures: dict[str, Any] = json.loads(done.stdout)["deadlines"]
    return figures


def cost(there: Path, rounds: int, seconds: float) -> None:
    """Missed deadlines in each way, alternately; the browser keeps off the loop's core."""
    os.sched_setaffinity(0, CORES - {max(CORES)} or CORES)
    found: dict[str, list[dict[str, Any]]] = {way: [] for way in WAYS}
    deadlines(there, 2.0)  # compiles
    for number in range(rounds):
        for way in WAYS[number % 3 :] + WAYS[: number % 3]:
            with contextlib.ExitStack() as stack:
                if way != WAYS[0]:
                    stack.enter_context(dashboard(there, "--attach"))
                opened = stack.enter_context(page(there)) if way == WAYS[2] else None
                found[way].append(deadlines(there, seconds))
                if opened is not None:
                    found[way][-1]["fps"] = opened.evaluate("peaFrames.drawn") / seconds
    alone = sum(f["missed"] for f in found[WAYS[0]])
    print(f"{rounds} rounds of {seconds:g} s at 20 kHz, in turn\n")
    print("| the loop runs | missed | of all | beside alone | p99.9, µs | frames a second |")
    print("|---|---|---|---|---|---|")
    for way, each in found.items():
        missed = sum(f["missed"] for f in each)
        share = missed / (rounds * seconds * 20_000)
        p999 = statistics.median(f["lateness_us_p999"] for f in each)
        fps = f"{statistics.median(f['fps'] for f in each):.1f}" if "fps" in each[0] else "–"
        print(
            f"| {way} | {missed} | {share:.4%} | {missed / max(alone, 1):.2f} "
            f"| {p999:.0f} | {fps} |"
        )


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
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--long", type=float, metavar="S")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as there:
        folder = Path(there).resolve()
        if arguments.long:
            long(folder, arguments.long)
        else:
            cost(folder, arguments.rounds, arguments.seconds)


if __name__ == "__main__":
    main()
