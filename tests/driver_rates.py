"""How many cycles a second a driver sustains against its emulator, a process of its own.

python tests/driver_rates.py [RIG ...] [--seconds S] [--pty]

A cycle is one command and one position. Prints the rate, the times of a cycle in microseconds,
and the errors of the protocol that the device has counted.
"""

from __future__ import annotations

import argparse
import contextlib
import signal
import subprocess
import sys
import time
from collections.abc import Iterator

import numpy as np

from pea_core.config import resolve
from pea_drivers.emulator import Control
from pea_experiment import rig as rigs
from pea_plant import drivers
from pea_plant.plant import Params

RIGS = ("e727_emulated",)


@contextlib.contextmanager
def emulated(device: str, rig: str, pty: bool) -> Iterator[tuple[str, Control]]:
    """Address and control channel of an emulator, which ends with the block."""
    way = ["--pty"] if pty else ["--port", "0"]
    words = [sys.executable, "-m", "pea_cli.cli", "emulate", device, "--rig", rig, *way]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    try:
        address, control = (process.stdout.readline().strip() for _ in range(2))
        yield address, Control(control)
    finally:
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=60)


def measure(rig: str, seconds: float, pty: bool) -> str:
    """Run one rig's driver; a line for people."""
    values = rigs.read(rig)["plant"]
    device = values["driver.type"]
    with emulated(device, rig, pty) as (address, control):
        patient = {"driver.address": address, "driver.timeout_s": 2.0}
        plant = resolve("plant", Params, [values, patient])
        driver = drivers.make(plant.params, plant.T_s)
        driver.connect()
        times = []
        end = time.perf_counter() + seconds
        k = 0
        before = time.perf_counter()
        while before < end:
            driver.exchange(5.0 + 5.0 * np.sin(1e-3 * k))
            now = time.perf_counter()
            times.append(now - before)
            before = now
            k += 1
        driver.check()
        driver.close()
        errors = {n: c for n, c in control.log()["counts"].items() if n.startswith("error")}
        control.close()
    us = np.array(times) * 1e6
    quantiles = ", ".join(f"{q:g} %: {np.percentile(us, q):.0f}" for q in (50, 99, 99.9))
    way = address.partition(":")[0]
    return (
        f"{rig} over {way}: {k / seconds:.0f} cycles/s over {seconds:g} s; us a cycle {quantiles}, "
        f"longest {us.max():.0f}; errors {errors or 'none'}"
    )


def main() -> None:
    """Measure what the command line names."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("rigs", nargs="*", default=RIGS, metavar="RIG")
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--pty", action="store_true")
    arguments = parser.parse_args()
    for rig in arguments.rigs:
        print(measure(rig, arguments.seconds, arguments.pty), flush=True)


if __name__ == "__main__":
    main()
