"""Loops on devices that are processes here: compiled drivers beside an empty loop, the graph."""

from __future__ import annotations

import contextlib
import math
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

from pea_bench.distributed import transport
from pea_bench.plan import Plan
from pea_bench.rows import Job, Part, Row, Tick, interleaved
from pea_core import config
from pea_core.loop import LoopFault
from pea_experiment import experiments, rig
from pea_experiment.experiment import AnyExperiment
from pea_experiment.experiments import PARAMS
from pea_plant.drivers.driver import DriverError
from pea_report.folder import commands
from pea_run import doctor
from pea_run.deadlines import Deadlines
from pea_run.modes import composed, distributed

NAME = "fig9_hysteresis_10hz"

COMPILED = {"udp": "board_emulated", "registers": "registers_emulated"}
"""Rigs at 20 kHz with a compiled driver."""

GRAPH = "e727_emulated"
SINE = (
    *("reference.frequency_hz=1", "plant.safety.stale_samples=400"),
    *("plant.safety.following_samples=400", "plant.safety.stuck_samples=400"),
)
"""The desired displacement, and limits that bear a machine which is halted now and then."""

RATES = {
    "1khz": (
        *("T_s=0.001", *SINE),
        *("observer.preset=kalman_rate_slow", "controller.preset=disturbance_observer"),
    ),
    "2khz": SINE,
}
"""What `GRAPH` is told at each rate."""

TRIES = 5
"""Attempts at one figure: a machine that is halted for long trips the safety gate."""

PATIENCE = 10.0
"""Seconds that a device has to end."""


class Found(NamedTuple):
    """What a loop in wall time has shown.

    Attributes
    ----------
    deadlines : Deadlines
    exchange_p50, exchange_p999 : float
        Of the exchange (us); NaN with a driver in Python.
    lost : int
        Samples that were left out after a halt, or never came.
    """

    deadlines: Deadlines
    exchange_p50: float
    exchange_p999: float
    lost: int

    @property
    def missed(self) -> float:
        """Share of the samples that were missed or left out."""
        of = self.deadlines
        return (of.missed + self.lost) / max(of.samples + self.lost, 1)


@contextlib.contextmanager
def device(name: str) -> Iterator[str]:
    """Emulate the device of a rig in a process of its own; its address.

    Raises
    ------
    OSError
        It does not start.
    """
    kind = str(rig.read(name)["plant"]["driver.type"])
    last = distributed.core()
    with tempfile.TemporaryDirectory(dir="/dev/shm") as folder:
        own = rig.path_of(name)
        options = [] if kind not in COMPILED else ["--set", f"cpu={last}"]
        if kind == "registers":  # its address is a file: another one than the rig's
            text = own.read_text(encoding="utf-8")
            address = rig.read(name)["plant"]["driver.address"]
            own = Path(folder) / "rig.yaml"
            own.write_text(text.replace(address, f"{folder}/registers"), encoding="utf-8")
        command = [sys.executable, "-m", "pea_cli.cli", "emulate", kind, "--rig", str(own)]
        process = subprocess.Popen(
            [*command, *options, "--port", "0"],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        assert process.stdout is not None
        try:
            address, control = (process.stdout.readline().strip() for _ in range(2))
            if not control:
                raise OSError(f"pea emulate {kind} --rig {name} does not start")
            yield address
        finally:
            process.send_signal(signal.SIGINT)
            try:
                process.communicate(timeout=PATIENCE)
            except subprocess.TimeoutExpired:
                process.kill()
                process.communicate()


def experiment(name: str, address: str, seconds: float, sets: Sequence[str] = ()) -> AnyExperiment:
    """The loop of the bench on a rig's device."""
    sets = [*sets, f"plant.driver.address={address}"]
    return experiments.load_axes(NAME, sets, seconds, rig=name)


def core() -> int:
    """Core for a loop beside a device, which has the last one."""
    return min(os.sched_getaffinity(0))


def loop(name: str, seconds: float, sets: Sequence[str] = ()) -> Found:
    """Run composed mode in wall time on a rig's device, recorded."""
    with device(name) as address, tempfile.TemporaryDirectory() as there:
        made = experiment(name, address, seconds, sets)
        out = Path(there) / "run"
        cpu = core() if name in COMPILED.values() else None
        deadlines = composed.run(made, out, lambda k: None, wall=True, cpu=cpu)
    assert deadlines is not None
    told = deadlines.conditions
    p50, p999 = (float(told.get(f"exchange_us_{q}", math.nan)) for q in ("p50", "p999"))
    return Found(deadlines, p50, p999, int(told.get("lost_by_device", 0)))


def empty(name: str, seconds: float) -> Found:
    """Make the same exchange in a loop that does nothing else, with the output held."""
    with device(name) as address:
        made = experiment(name, address, seconds).each[0]
        found = doctor.line(made.nodes["plant"].params, made.T_s, seconds, core())
    p50, p999 = (found.exchanges.quantile(q) / 1e3 for q in (0.5, 0.999))
    return Found(found.deadlines, p50, p999, found.lost)


def graph(name: str, seconds: float, sets: Sequence[str] = ()) -> float:
    """Share of the samples whose command comes late over the graph, recorded."""
    with device(name) as address, tempfile.TemporaryDirectory() as there, transport("turbo"):
        made = experiment(name, address, seconds, sets)
        out = Path(there)
        config.write(out / PARAMS, made.sections())
        distributed.run(made, out, lambda k: None, wall=True)
        return commands(out)["late"] / made.samples


def steps(plan: Plan) -> int:
    """How often `measure` tells that it goes on."""
    return (2 * len(COMPILED) + 2 * len(RATES)) * plan.device_rounds


def measure(plan: Plan, tick: Tick) -> Part:
    """Measure each loop, and what it is compared with, in turn."""
    tripped: list[str] = []

    def held(job: Callable[[], Any]) -> Any:
        for _ in range(TRIES):
            try:
                return job()
            except (LoopFault, DriverError) as error:
                tripped.append(str(error))
        return None

    rounds: dict[str, list[Found]] = {}

    def missed(key: str, job: Callable[[], Found]) -> float:
        found = held(job)
        rounds.setdefault(key, []).extend([found] if found else [])
        return found.missed if found else math.nan

    def late(job: Job) -> float:
        found = held(job)
        return math.nan if found is None else float(found)

    seconds, jobs = plan.device_s, dict[str, Job]()
    for kind, name in COMPILED.items():
        jobs[kind] = partial(missed, kind, partial(loop, name, seconds))
        jobs[f"{kind}_empty"] = partial(missed, f"{kind}_empty", partial(empty, name, seconds))
    for rate, sets in RATES.items():
        jobs[f"graph_{rate}"] = partial(late, partial(graph, GRAPH, seconds, sets))
        jobs[f"composed_{rate}"] = partial(
            missed, f"composed_{rate}", partial(loop, GRAPH, seconds, sets)
        )
    measured = interleaved(jobs, plan.device_rounds, tick)
    found = {name: tuple(x for x in values if x == x) for name, values in measured.items()}
    rows = []
    for kind, ratio, p50 in (("udp", "<= 2", ""), ("registers", "<= 1.3", "<= 3")):
        rows += _compiled(kind, rounds, found, ratio, p50)
    for rate, demand in (("1khz", "<= 0.003"), ("2khz", "<= 0.01")):
        rows += _graph(rate, found, demand)
    rows.append(Row("hardware.trips", "rounds begun anew after a trip", "", (len(tripped),)))
    notes = [f"Tripped, and begun anew: {text}." for text in dict.fromkeys(tripped)]
    return Part(rows, {}, notes)


def _compiled(
    kind: str,
    rounds: dict[str, list[Found]],
    found: dict[str, tuple[float, ...]],
    ratio: str,
    p50: str,
) -> list[Row]:
    """Rows of a compiled driver beside the empty loop."""
    at, idle = f"hardware.{kind}", f"{kind}_empty"
    ours, theirs = rounds[kind], rounds[idle]
    pair = found[kind], found[idle]
    missed, nothing = (median(values) if values else 0.0 for values in pair)
    rows = []
    for key, who, each in (("", "", ours), ("_empty", ", empty loop", theirs)):
        for q in ("p50", "p999"):
            values = tuple(getattr(one, f"exchange_{q}") for one in each)
            demand = p50 if not key and q == "p50" else ""
            name = f"{at}{key}_exchange_us_{q}"
            rows.append(Row(name, f"{kind}: exchange {q}{who}", "us", values, demand))
        late = tuple(one.deadlines.quantile(0.999) / 1e3 for one in each)
        rows.append(Row(f"{at}{key}_lateness_us_p999", f"{kind}: lateness p999{who}", "us", late))
        what = f"{kind}: missed or left out{who}"
        rows.append(Row(f"{at}{key}_missed_fraction", what, "", found[kind if not key else idle]))
    whole = [sum(values) / max(len(values), 1) for values in pair]
    return [
        *rows,
        Row(
            f"{at}_missed_ratio",
            f"{kind}: loop : empty loop, medians of the rounds",
            "",
            (missed / nothing,) if nothing and ours else (),
            ratio,
        ),
        Row(
            f"{at}_missed_together",
            f"{kind}: loop : empty loop, all rounds as one run",
            "",
            (whole[0] / whole[1],) if whole[1] and ours else (),
        ),
    ]


def _graph(rate: str, found: dict[str, tuple[float, ...]], demand: str) -> list[Row]:
    """Rows of the graph beside the loop in one process, on the same device."""
    words = rate.replace("khz", " kHz")
    return [
        Row(
            f"hardware.graph_late_{rate}",
            f"commands late over the graph, {words}",
            "",
            found[f"graph_{rate}"],
            demand,
        ),
        Row(
            f"hardware.composed_missed_{rate}",
            f"deadlines missed in one process, {words}",
            "",
            found[f"composed_{rate}"],
        ),
    ]
