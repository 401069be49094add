"""What this machine can hold in wall time, and what to change: ``pea doctor``."""

from __future__ import annotations

import os
import resource
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pea_core.axes import per_axis
from pea_core.units import SECOND
from pea_engine import pace
from pea_engine.compiled import WORTH, wanted
from pea_engine.kernels import empty_kernel
from pea_engine.pace import PRIORITY, SPIN_NS
from pea_native.device import Native
from pea_native.library import CLOCK, DEVICE
from pea_native.measure import Exchanged, exchanges
from pea_plant import drivers
from pea_run.deadlines import Deadlines

T_NS = 50_000
"""Period of the measured loop (ns): the paper's."""

WARM_UP = 2000
"""Samples that are not counted: caches, page faults, clock speed."""

GOOD, FAIR = 1e-4, 1e-2
"""Missed fractions up to which a machine holds the rate, and holds it with gaps."""


class Finding(NamedTuple):
    """One thing about the machine.

    Attributes
    ----------
    what : str
        What was looked at.
    found : str
        What it is.
    fine : bool
        Whether it may stay so.
    advice : str
        What to do where it may not.
    """

    what: str
    found: str
    fine: bool
    advice: str


def _read(path: Path) -> str:
    """First line of a file; empty where there is none."""
    try:
        return path.read_text(errors="replace").strip().partition("\n")[0]
    except OSError:
        return ""


def _finding(what: str, found: str, fine: bool, advice: str) -> Finding:
    return Finding(what, found, fine, "" if fine else advice)


def cpus_of(text: str) -> set[int]:
    """Numbers in a list like ``1,4-7``, as the kernel writes it."""
    found: set[int] = set()
    for part in filter(None, text.split(",")):
        first, _, last = part.partition("-")
        found |= set(range(int(first), int(last or first) + 1))
    return found


def cores(usable: set[int]) -> Finding:
    """One core for the loop, one for everything else."""
    count = len(usable)
    return _finding(
        "cores", str(count), count >= 2, "give it two: one for the loop, one for all else"
    )


def preemption(root: Path, version: str) -> Finding:
    """A PREEMPT_RT kernel bounds how long the loop waits for the system."""
    real_time = _read(root / "sys/kernel/realtime") == "1" or "PREEMPT_RT" in version
    kind = next((word for word in version.split() if word.startswith("PREEMPT")), "not preemptive")
    return _finding(
        "kernel",
        "PREEMPT_RT" if real_time else kind,
        real_time,
        "boot a PREEMPT_RT kernel (Debian: linux-image-rt-amd64; Ubuntu: pro enable realtime)",
    )


def virtual(root: Path) -> Finding:
    """On a virtual machine the host takes cores away unseen."""
    is_virtual = " hypervisor" in _flags(root)
    return _finding(
        "machine",
        "virtual" if is_virtual else "real",
        not is_virtual,
        "a virtual machine's cores are taken away at any time: use a real one for a rig",
    )


def _flags(root: Path) -> str:
    try:
        lines = (root / "proc/cpuinfo").read_text(errors="replace").splitlines()
    except OSError:
        return ""
    return next((line for line in lines if line.startswith("flags")), "")


def isolated(root: Path, usable: set[int], cpu: int | None) -> Finding:
    """A core that the scheduler leaves alone."""
    cores = cpus_of(_read(root / "sys/devices/system/cpu/isolated"))
    last = max(usable)
    fine = cpu in cores if cpu is not None else bool(cores)
    return _finding(
        "isolated cores",
        ", ".join(map(str, sorted(cores))) or "none",
        fine,
        f"boot with isolcpus={last} nohz_full={last} rcu_nocbs={last}, then run with --cpu {last}",
    )


def governor(root: Path, usable: set[int]) -> Finding:
    """A clock that slows down in the sleeps of the loop makes the next sample late."""
    folder = root / "sys/devices/system/cpu"
    found = {_read(folder / f"cpu{cpu}/cpufreq/scaling_governor") for cpu in usable} - {""}
    return _finding(
        "frequency governor",
        ", ".join(sorted(found)) or "none (fixed, or the host's)",
        found <= {"performance"},
        "cpupower frequency-set -g performance",
    )


def clock_source(root: Path) -> Finding:
    """A clock that is read without a system call, in some 30 ns."""
    found = _read(root / "sys/devices/system/clocksource/clocksource0/current_clocksource")
    fine = found in ("tsc", "kvm-clock", "arch_sys_counter")
    return _finding("clock source", found or "unknown", fine, "boot with clocksource=tsc")


def priority(limit: int, root_user: bool) -> Finding:
    """SCHED_FIFO, so that no ordinary process runs before the loop."""
    infinite = limit == resource.RLIM_INFINITY
    fine = root_user or infinite or limit >= PRIORITY
    return _finding(
        "real-time priority",
        "permitted" if fine else f"up to {limit}",
        fine,
        f"/etc/security/limits.conf: @realtime - rtprio {PRIORITY}; then log in again",
    )


def throttling(root: Path) -> Finding:
    """Real-time threads that spin all the time are stopped for a while each second."""
    runtime = _read(root / "proc/sys/kernel/sched_rt_runtime_us")
    period = _read(root / "proc/sys/kernel/sched_rt_period_us")
    share = 1.0
    if runtime not in ("", "-1") and period:
        share = int(runtime) / int(period)
    fine = share >= 0.8
    return _finding(
        "real-time share",
        "unlimited" if share == 1.0 else f"{share:.0%} of a core",
        fine,
        "sysctl kernel.sched_rt_runtime_us=950000",
    )


def memory(limit: int, root_user: bool) -> Finding:
    """Memory that cannot be swapped out."""
    infinite = limit == resource.RLIM_INFINITY
    fine = root_user or infinite
    return _finding(
        "locked memory",
        "permitted" if fine else f"up to {limit // 1024} KiB",
        fine,
        "/etc/security/limits.conf: @realtime - memlock unlimited; then log in again",
    )


def idle_states(root: Path, root_user: bool) -> Finding:
    """Deep idle states take up to 0.1 ms to leave."""
    folder = root / "sys/devices/system/cpu/cpu0/cpuidle"
    slowest = 0
    for path in folder.glob("state*/latency"):
        if _read(path.with_name("disable")) != "1":
            slowest = max(slowest, int(_read(path) or 0))
    latency = root / "dev/cpu_dma_latency"
    ours = root_user or os.access(latency, os.W_OK)
    return _finding(
        "idle states",
        f"up to {slowest} us to leave" if slowest else "none, or the host's",
        slowest <= 10 or ours,
        f"let your user write {latency}, or boot with processor.max_cstate=1",
    )


def slack(ns: int) -> Finding:
    """How late timers may be; the loop's thread sets 1 ns for itself."""
    return _finding("timer slack", f"{ns / 1e3:g} us, set to 1 ns in the loop", True, "")


def findings(cpu: int | None = None, root: Path = Path("/")) -> list[Finding]:
    """Look at the machine.

    Parameters
    ----------
    cpu : int, optional
        Core meant for the loop.
    root : Path
        Where ``proc``, ``sys`` and ``dev`` are.
    """
    usable = os.sched_getaffinity(0)
    root_user = os.geteuid() == 0
    looks: tuple[Callable[[], Finding], ...] = (
        lambda: cores(usable),
        lambda: virtual(root),
        lambda: preemption(root, os.uname().version),
        lambda: isolated(root, usable, cpu),
        lambda: governor(root, usable),
        lambda: idle_states(root, root_user),
        lambda: clock_source(root),
        lambda: priority(resource.getrlimit(resource.RLIMIT_RTPRIO)[0], root_user),
        lambda: throttling(root),
        lambda: memory(resource.getrlimit(resource.RLIMIT_MEMLOCK)[0], root_user),
        lambda: slack(pace.timer_slack()),
    )
    return [look() for look in looks]


def measure(seconds: float, cpu: int | None = None, T_ns: int = T_NS) -> Deadlines:
    """Keep time for a while and do nothing else.

    Parameters
    ----------
    seconds : float
        How long (s), after a warm-up.
    cpu : int, optional
        Core to stay on.
    T_ns : int
        Period (ns).
    """
    kernel = empty_kernel(wanted(WORTH))
    spin = min(SPIN_NS, T_ns // 2)
    times = np.zeros((WARM_UP + round(seconds * SECOND / T_ns), 2), np.int64)
    kernel(0, T_ns, spin, times[:0])  # compiles
    deadlines = Deadlines(T_ns)

    def run() -> None:
        standing = pace.settle(cpu)
        kernel(pace.now() + T_ns, T_ns, spin, times)
        deadlines.conditions = {**standing._asdict(), "memory_locked": locked, "cpu": cpu}

    with pace.memory_locked() as locked, pace.awake(), pace.apart(cpu):
        thread = threading.Thread(target=run, name="empty loop", daemon=True)
        thread.start()
        thread.join()
    deadlines.add(times[WARM_UP:])
    return deadlines


class DeviceExchange(NamedTuple):
    """What the exchange with a rig's device has shown.

    Attributes
    ----------
    identity : str
        Who answered.
    paced : bool
        Whether the device sets the pace.
    deadlines : Deadlines
        Of an empty loop that makes the exchange at the rig's rate, the output held.
    exchanges : Deadlines
        How long the exchanges took, as lateness.
    lost : int
        Samples of the device that never came.
    """

    identity: str
    paced: bool
    deadlines: Deadlines
    exchanges: Deadlines
    lost: int

    def figures(self) -> dict[str, Any]:
        """As ``metrics.json`` names them."""
        return {
            **self.exchanges.exchange(),
            "lost_by_device": self.lost,
            **self.deadlines.figures(),
        }


def line(plant: Any, T_s: float, seconds: float, cpu: int | None = None) -> DeviceExchange:
    """Make the exchange of a rig at its rate for a while; nothing is commanded.

    Parameters
    ----------
    plant : pea_plant.plant.Params
        Of several axes, which are channels of one device, a tuple of them.
    T_s : float
        Sample period (s).
    seconds : float
    cpu : int, optional
        Core to stay on.

    Raises
    ------
    ParameterError, DriverError
        The device is not there, or not what the rig says.
    """
    T_ns = round(T_s * SECOND)
    samples = max(round(seconds / T_s), 1)
    driver = drivers.make(plant, T_s)
    deadlines, took = Deadlines(T_ns), Deadlines(T_ns)
    with pace.memory_locked() as locked, pace.awake(), pace.apart(cpu):
        driver.connect()
        try:
            if isinstance(driver, Native):
                found = exchanges(driver, samples, cpu, compiled=wanted(WORTH))
            else:
                found = _reads(driver, samples, T_ns, cpu)
            identity = driver.identity
        finally:
            driver.close()
    deadlines.add(found.times)
    took.add(np.column_stack((found.took, found.took)))
    deadlines.conditions = {"memory_locked": locked, "cpu": cpu}
    paced = getattr(per_axis(plant)[0].driver, "pace", CLOCK) == DEVICE
    return DeviceExchange(identity, paced, deadlines, took, found.lost)


def _reads(driver: Any, samples: int, T_ns: int, cpu: int | None) -> Exchanged:
    """The same with a driver written in Python: it reads, each period."""
    times, took = np.zeros((samples, 2), np.int64), np.zeros(samples, np.int64)
    failed: list[Exception] = []

    def run() -> None:
        pace.settle(cpu)
        t_0 = pace.now() + T_ns
        try:
            for k in range(samples):
                due = t_0 + k * T_ns
                begun = pace.wait_until(due, min(SPIN_NS, T_ns // 2))
                driver.read()
                came = pace.now()
                took[k] = came - begun
                times[k] = begun - due, came - due
        except Exception as error:
            failed.append(error)

    thread = threading.Thread(target=run, name="exchanges", daemon=True)
    thread.start()
    thread.join()
    if failed:
        raise failed[0]
    return Exchanged(times, took, 0)


def holds(found: DeviceExchange) -> str:
    """Which rate holds, and what limits it, in a line."""
    T_us = found.deadlines.T_ns / 1e3
    took = {name: found.exchanges.quantile(q) / 1e3 for name, q in (("p50", 0.5), ("p999", 0.999))}
    late = found.deadlines.quantile(0.999) / 1e3
    rate = 1e6 / T_us
    missed = found.deadlines.missed_fraction
    kept = f"{missed:.2g} of the samples missed"
    if found.paced:
        fine = missed <= FAIR and not found.lost
        limit = "the machine" if late > T_us else "the device's clock"
        return (
            f"{rate:g} Hz, the device's pace: {'held' if fine else 'not held'}, {kept}, "
            f"{found.lost} lost; limited by {limit} (arrivals late by {late:.3g} us p99.9)"
        )
    fits = 1e6 / max(took["p999"] + late, 1e-3)
    limit = "the exchange" if took["p999"] >= late else "the machine"
    return (
        f"{rate:g} Hz: {'held' if missed <= FAIR else 'not held'}, {kept}; up to {fits:.3g} Hz fit "
        f"99.9 % of the samples, limited by {limit} (exchange {took['p999']:.3g} us p99.9, "
        f"begun late by {late:.3g} us)"
    )


def verdict(deadlines: Deadlines) -> str:
    """What the measured loop says, in a line."""
    missed = deadlines.missed / max(deadlines.samples, 1)
    rate = SECOND / deadlines.T_ns
    if missed <= GOOD:
        return f"{rate:g} Hz: held, {missed:.2g} of the deadlines missed"
    if missed <= FAIR:
        return (
            f"{rate:g} Hz: held with gaps, {missed:.2g} of the deadlines missed, "
            f"{deadlines.longest_burst} in a row at most: good for simulation, not for a rig"
        )
    return f"{rate:g} Hz: not held, {missed:.2g} of the deadlines missed"
