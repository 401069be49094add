"""The run that the dashboard starts: ``pea run`` as a process of its own.

It has a session of its own, so that neither Ctrl-C nor the end of the dashboard reaches it, and
it holds the ROS domain for as long as it lives.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import yaml

from pea_core.config import CLOCKS, COMPOSED, DISTRIBUTED, NAMESPACE
from pea_core.params import ParameterError, Text, Value, nearest, number_of
from pea_dashboard.foreign import plain
from pea_experiment import experiments
from pea_experiment.experiment import AnyExperiment
from pea_experiment.experiments import PARAMS
from pea_report.folder import METRICS, REPORT
from pea_ros import shared_memory
from pea_run.modes.distributed import environment

MODES = COMPOSED, DISTRIBUTED  # in mode batch nothing is to be seen while it runs

OUTCOMES = {0: "done", 2: "refused", 3: "failed", 130: "ended"}
"""What an exit status means."""

TAIL = 2**16
"""Bytes of what a run has written that are looked at."""


@dataclass(frozen=True)
class RunPlan:
    """What shall run.

    Attributes
    ----------
    experiment : str
        Name, or path of a file.
    mode : str
        ``composed`` or ``distributed``.
    wall : bool
        On the clock.
    rig : str
        Name of a rig; empty: the simulated plant.
    duration : float or None
        Seconds of loop time; None: as the experiment says.
    record : bool
        Whether the run leaves a recording.
    namespace : str
        Where its nodes are.
    sets : mapping of str to str
        ``NODE.PARAM`` and values that replace those of the experiment.
    """

    experiment: str
    mode: str = COMPOSED
    wall: bool = True
    rig: str = ""
    duration: float | None = None
    record: bool = True
    namespace: str = NAMESPACE
    sets: Mapping[str, Value] = field(default_factory=dict)

    @property
    def assignments(self) -> list[str]:
        """As after ``--set``."""
        return [f"{name}={_yaml(value)}" for name, value in self.sets.items()]

    @property
    def arguments(self) -> list[str]:
        """Of ``pea run``."""
        words = ["run", self.experiment, "--mode", self.mode]
        words += ["--clock", "wall"] if self.wall and not self.rig else []
        words += ["--rig", self.rig] if self.rig else []
        if self.mode == COMPOSED and self.wall and (cpu := loop_core()) is not None:
            words += ["--cpu", str(cpu)]
        words += [] if self.duration is None else ["--duration", repr(self.duration)]
        words += [] if self.record else ["--no-record"]
        if self.namespace != NAMESPACE:
            words += ["--namespace", self.namespace]
        return words + [word for each in self.assignments for word in ("--set", each)]

    def load(self) -> AnyExperiment:
        """The experiment of all its axes, checked.

        Raises
        ------
        ParameterError
            It cannot run; the text says why.
        """
        rig = self.rig or None
        return experiments.load_axes(self.experiment, self.assignments, self.duration, rig=rig)


def loop_core() -> int | None:
    """Core that is the loop's: the last of several, as in distributed mode."""
    cores = _cores()
    return max(cores) if len(cores) > 1 else None


def keep_off() -> None:
    """Keep this thread, and those that it makes, off the loop's core."""
    cores = _cores()
    if len(cores) > 1:
        os.sched_setaffinity(0, cores - {max(cores)})


@cache
def _cores() -> frozenset[int]:
    """Cores that this process had at its start."""
    return frozenset(os.sched_getaffinity(0))


@contextlib.contextmanager
def _everywhere() -> Iterator[None]:
    """Let what is started meanwhile have all cores."""
    now = os.sched_getaffinity(0)
    os.sched_setaffinity(0, _cores())
    try:
        yield
    finally:
        os.sched_setaffinity(0, now)


def _yaml(value: Value) -> str:
    """A value as it is typed behind ``--set NAME=``."""
    if isinstance(value, tuple | list):
        return f"[{', '.join(map(_yaml, value))}]"
    if isinstance(value, Text) and number_of(value) is not None:
        return str(value)  # as it was typed
    told = str(value) if isinstance(value, str) else value
    return yaml.safe_dump(told, default_flow_style=True).split("\n")[0]


class Child:
    """One run at a time, in a ROS domain.

    Parameters
    ----------
    domain : int
        The ROS domain.
    holder : socket or None
        What holds it; the run inherits it.

    Attributes
    ----------
    plan : RunPlan or None
        What was started last.
    outcome : str
        How that has ended, in one line; empty while it runs.
    failed : bool
        Whether it has ended in a way that was not asked for.
    report : str
        Report of the run that has ended: an HTML page, or a picture; empty while there is none.
    """

    def __init__(self, domain: int, holder: socket.socket | None = None) -> None:
        self.domain = domain
        self.holder = holder
        self.plan: RunPlan | None = None
        self.outcome = ""
        self.failed = False
        self.report = ""
        self.process: subprocess.Popen[bytes] | None = None
        self._one = threading.Lock()

    @property
    def runs(self) -> bool:
        """Whether it runs."""
        return self.process is not None and not self.outcome

    def start(self, plan: RunPlan) -> None:
        """Start a run.

        Raises
        ------
        ParameterError
            It cannot run, or another one does.
        """
        with self._one:
            if self.runs:
                raise ParameterError("a run is in progress: stop it first")
            plan.load()
            log = os.memfd_create("pea-run")  # needs no folder, and nothing of it is left behind
            with environment() as (env, _), _everywhere():
                self.process = subprocess.Popen(
                    [sys.executable, "-P", "-m", "pea_cli.cli", *plan.arguments],
                    env={
                        **env,
                        "ROS_DOMAIN_ID": str(self.domain),
                        "COLUMNS": "200",
                        "PEA_SCORE": "0",  # a stop waits for no score: `_score`
                    },
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=log,
                    start_new_session=True,
                    pass_fds=() if self.holder is None else (self.holder.fileno(),),
                )
            self.plan, self.outcome, self.report = plan, "", ""
            threading.Thread(target=self._wait, args=(self.process, log), daemon=True).start()

    def stop(self) -> None:
        """Ask the run to end between two samples; it closes its recording."""
        if self.process is not None and self.runs:
            with contextlib.suppress(ProcessLookupError):
                self.process.send_signal(signal.SIGINT)

    def _wait(self, process: subprocess.Popen[bytes], log: int) -> None:
        status = process.wait()
        with open(log, errors="replace") as console:
            console.seek(max(os.fstat(log).st_size - TAIL, 0))
            words = console.read().splitlines()
        if status < 0:  # killed: it has cleaned up nothing
            shared_memory.sweep()
        said = [line.strip().removeprefix("pea: ") for line in words if line.strip()]
        where = next((line.split()[-1] for line in reversed(said) if "runs/" in line), "")
        reasons = [line for line in said if "what was recorded is in" not in line]
        told = [OUTCOMES.get(status, _status(status))]
        self.failed = status not in (0, 130)
        told += reasons[-1:] if self.failed else []
        self.outcome = plain(": ".join(told) + (f" ({where})" if where else ""), 1000)
        folder = Path(where if Path(where).is_dir() else Path(where).parent)
        if where and (folder / PARAMS).exists():
            self.score(process, folder)

    def score(self, process: subprocess.Popen[bytes], folder: Path) -> None:
        """See that a run has metrics and a report, also one that was stopped.

        A process of its own makes them: nobody has to wait for it.
        """
        report = folder / REPORT
        if not (folder / METRICS).exists():
            command = [sys.executable, "-P", "-m", "pea_cli.cli", "report", str(folder), "--json"]
            done = subprocess.run(
                ["nice", *command], stdin=subprocess.DEVNULL, capture_output=True, check=False
            )
            try:
                told = json.loads(done.stdout)
                (figures,) = told["metrics"].values()
                text = json.dumps(figures, indent=2)
                (folder / METRICS).write_text(text + "\n", encoding="utf-8")
                report = Path(told["html"])
            except (ValueError, OSError):  # too little was recorded to be scored, for example
                last = done.stderr.decode(errors="replace").strip().rpartition("\n")[2]
                report = Path()
                if process is self.process:
                    self.outcome += plain(f"; no report: {last.removeprefix('pea: ')}")
        if process is self.process and report.is_file():
            self.report = str(report.resolve())


def _status(status: int) -> str:
    if status < 0:
        return f"killed by {signal.Signals(-status).name}"
    return f"ended with status {status}"


def domain() -> tuple[int, Any]:
    """ROS domain of the dashboard: the user's, or a free one and the socket that holds it."""
    from pea_run.modes.distributed import own_domain

    chosen = os.environ.get("ROS_DOMAIN_ID")
    return (int(chosen), None) if chosen else own_domain()


def plan_of(arguments: Any) -> RunPlan:
    """What the command line says shall run.

    Raises
    ------
    ParameterError
        It cannot.
    """
    if arguments.mode not in MODES:
        raise ParameterError(f"--mode {arguments.mode!r}: {nearest(arguments.mode, MODES)}")
    if arguments.clock not in CLOCKS:
        raise ParameterError(f"--clock {arguments.clock!r}: {nearest(arguments.clock, CLOCKS)}")
    try:
        duration = float(arguments.duration)
    except ValueError:
        raise ParameterError(f"--duration {arguments.duration!r}: give a number") from None
    sets = {
        f"{node}.{name}": value
        for node, values in experiments.parse_set(arguments.sets).items()
        for name, value in values.items()
    }
    plan = RunPlan(
        arguments.run or next(iter(experiments.names())),
        arguments.mode,
        arguments.clock == "wall",
        arguments.rig,
        duration,
        namespace=arguments.namespace,
        sets=sets,
    )
    if arguments.run:
        plan.load()
    return plan
