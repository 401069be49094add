"""An empty loop that makes the same exchange: what the line, the device and the machine hold."""

from __future__ import annotations

import ctypes
import math
import threading
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from pea_engine import pace
from pea_engine.kernel import compile_kernel, open_sources
from pea_native import call, cycle
from pea_native.device import Native
from pea_native.library import DEVICE, FRESH, HOLD, code_of
from pea_plant.drivers.driver import DriverError


class Exchanged(NamedTuple):
    """What an empty loop has shown.

    Attributes
    ----------
    times : (n, 2) array of int64
        How long after its deadline each sample has begun and ended (ns).
    took : (n,) array of int64
        How long each exchange took (ns); with the device's pace its wait is part of it.
    lost : int
        Samples of the device that never came.
    """

    times: np.ndarray
    took: np.ndarray
    lost: int


def held_kernel(compiled: bool = True) -> Callable[..., Any]:
    """Compile a loop that makes exchanges and nothing else."""
    exchange, timed = call.exchange, cycle.paced_by
    sources = ""
    if compiled:
        pace.native()
        call.native()
        sources = open_sources(pace.wait_until, timed)

    def kernel(
        function: int,
        device: int,
        u: float,
        flags: int,
        t_0: int,
        T_ns: int,
        paced: bool,
        spin: int,
        sample: np.ndarray,
        counter: np.ndarray,
        counts: np.ndarray,
        times: np.ndarray,
        took: np.ndarray,
    ) -> int:
        sources  # noqa: B018
        for k in range(len(times)):
            due = t_0 + k * T_ns
            begun = pace.now()
            if not paced:
                begun = pace.wait_until(due, spin)
            fresh = FRESH if k == 0 else 0
            code = exchange(function, device, u, flags | fresh, sample)
            came = pace.now()
            if code != 0:
                return code
            took[k] = came - begun
            if paced:
                timed(counts, T_ns, counter[2], came)
                due, begun = counts[cycle.DUE, 0], came
            times[k, 0] = begun - due
            times[k, 1] = pace.now() - due
        return 0

    return compile_kernel(kernel) if compiled else kernel


def exchanges(
    driver: Native, samples: int, cpu: int | None = None, u: float = math.nan, compiled: bool = True
) -> Exchanged:
    """Make exchanges with a connected device, at the pace of its rig.

    Parameters
    ----------
    driver : Native
        Connected.
    samples : int
    cpu : int, optional
        Core to stay on.
    u : float
        Voltage (V) that each commands; NaN: the output is held.

    Raises
    ------
    DriverError
        An exchange failed.
    """
    assert driver.loaded is not None
    kernel = held_kernel(compiled)
    place = ctypes.cast(driver.loaded.functions["exchange"], ctypes.c_void_p).value or 0
    T_ns = driver.line.period_ns
    sample = np.zeros(3)
    counts = np.zeros((cycle.CELLS, pace.LINE), np.int64)
    times, took = np.zeros((samples, 2), np.int64), np.zeros(samples, np.int64)
    flags = HOLD if math.isnan(u) else 0
    paced = driver.line.pace == DEVICE
    ends: list[int] = []

    def call_it(t_0: int, n: int) -> int:
        spin = min(pace.SPIN_NS, T_ns // 2)
        head = (place, driver.loaded.device, u, flags, t_0, T_ns, paced, spin)  # type: ignore[union-attr]
        return int(kernel(*head, sample, sample.view(np.int64), counts, times[:n], took[:n]))

    def run() -> None:
        pace.settle(cpu)
        ends.append(call_it(pace.now() + T_ns, samples))

    call_it(0, 0)  # compiles
    thread = threading.Thread(target=run, name="exchanges", daemon=True)
    thread.start()
    thread.join()
    if ends[0]:
        raise DriverError(f"{driver.line.address}: {code_of(ends[0])}")
    return Exchanged(times, took, int(counts[cycle.LOST, 0]))
