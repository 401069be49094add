"""What every browser shows and works on: one run, one set of values, one history."""

from __future__ import annotations

import contextlib
import threading
import time
from collections import deque
from pathlib import Path
from typing import Any

from pea_core.config import NODES
from pea_core.params import ParameterError
from pea_runtime import experiments, rig
from pea_runtime.dashboard.child import Child, Plan
from pea_runtime.dashboard.link import Link
from pea_runtime.dashboard.recording import Recordings
from pea_runtime.dashboard.stop import Stop
from pea_runtime.dashboard.trace import Trace
from pea_runtime.dashboard.truth import Truth
from pea_runtime.dashboard.tuning import Tuning
from pea_runtime.guard import experiment_of
from pea_runtime.run import COUNTS

KEEP_EVERY = 0.2
"""Seconds between two looks at what runs."""

FOLLOW_EVERY = 0.04
"""Seconds between two looks at new samples."""

RATE_OVER = 3.0
"""Seconds over which the rate is told: samples come in blocks."""

SILENT = 2.0
"""Seconds without a new sample after which a loop stands still."""


NOTHING = ("none", "–")

HEALTH = ("rate", "missed", "lost", "safety", "recorder", "truth", "outcome")
"""What is to be watched."""


class Desk:
    """State of the dashboard.

    Parameters
    ----------
    child : Child
        Starts runs.
    attached : bool
        Whether runs of others are looked at; then none is started here.
    bag : str
        A recording to open.
    plan : Plan
        What would be started.
    """

    def __init__(self, child: Child, attached: bool, bag: str, plan: Plan) -> None:
        self.child = child
        self.attached = attached
        self.tuning = Tuning()
        self.trace = Trace()
        self.link = Link(self.trace, self.tuning.changed)
        self.stop = Stop(child.domain)
        self.recordings = Recordings(Path("runs"), bag)
        self.experiments = {name: about.description for name, about in experiments.names().items()}
        self.rigs = rig.names()
        self.plan = plan
        self.period = 0.0
        self.limits: tuple[float, float] | None = None
        self.notice = ""
        self.rate = 0.0
        self._seen: deque[tuple[float, int]] = deque()
        self._run = -1
        self._moved = 0.0
        self._rested: Any = None
        self._judged: Any = None
        self._ended = threading.Event()
        self.truth = Truth(self.trace)
        self._threads = [
            threading.Thread(target=do, name=name, daemon=True)
            for name, do in (("desk", self._keep), ("truth", self._follow))
        ]
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """Leave; what runs goes on."""
        self._ended.set()
        for thread in self._threads:
            thread.join(5.0)
        self.link.close()
        self.stop.close()
        self.child.close()

    # What runs

    @property
    def running(self) -> bool:
        """Whether there is a loop."""
        return bool(self.link.there)

    @property
    def state(self) -> str:
        """One word: idle, starting, running, standing, fault."""
        gate = self.gate
        if gate[0] == "fault":
            return "fault"
        if self.running:
            return "running" if time.monotonic() - self._moved < SILENT else "standing"
        return "starting" if self.child.runs else "idle"

    @property
    def gate(self) -> tuple[str, str]:
        """State of the plant's safety gate, and its reason; empty where there is none."""
        told = self.link.diagnostics.get("plant: gate")
        if told is None or not self.running:
            return "", ""
        reason = told.values.get("reason", "")
        return told.text, "" if reason == "none" else reason

    def health(self) -> dict[str, tuple[str, str]]:
        """Level and text of what is to be watched, by name."""
        if not self.running:
            found = dict.fromkeys(HEALTH, NOTHING)
            level = "bad" if self.child.failed else "none"
            return {**found, "outcome": (level, self.child.outcome or "–")}
        told = self.link.diagnostics
        loop, gate = told.get("loop"), self.gate
        T_ns = self.trace.T_ns
        due = 1e9 / T_ns if T_ns else 0.0
        missed, lost = NOTHING, ("good", "0")
        if loop is not None:
            share = float(loop.values.get("missed_fraction", "0"))
            number = loop.values.get("missed", "0")
            missed = ("warning" if loop.level else "good", f"{number} ({share:.3%})")
        elif "plant: gate" in told:
            kept = told["plant: gate"]
            counts = ", ".join(f"{kept.values.get(n, '0')} {n}" for n in COUNTS)
            missed = ("warning" if kept.level else "good", counts)
        losses = sum(int(each.values.get("lost_samples", "0")) for each in told.values())
        if losses:
            lost = ("bad", str(losses))
        elif self.trace.unseen:
            lost = ("good", f"0 ({self.trace.unseen} not seen here)")
        state, reason = gate
        safety = ("bad", f"{state}: {reason}") if state == "fault" else ("good", state or "no gate")
        return {
            "rate": ("good" if self.rate else "warning", f"{self.rate:,.0f} of {due:,.0f} Hz"),
            "missed": missed,
            "lost": lost,
            "safety": safety,
            "recorder": self._backlog(),
            "outcome": ("warning" if self.notice else "none", self.notice or "–"),
            "truth": ("none", self.truth.lost or "known"),
        }

    def _backlog(self) -> tuple[str, str]:
        """How far the recorder is behind."""
        loop = self.link.diagnostics.get("loop")
        if loop is not None and "backlog_samples" in loop.values:
            behind = int(loop.values["backlog_samples"])
        elif self.link.recorded >= 0:
            behind = max(self.trace.end - self.link.recorded, 0)
        else:
            return "none", "none"
        return "good", f"{behind} behind"

    def start(self) -> None:
        """Start the plan with the draft laid over it.

        Raises
        ------
        ParameterError
            It cannot run, or another one does.
        """
        if self.running:
            raise ParameterError("a loop runs in this ROS domain: stop it first")
        plan = self.plan
        sets = {**plan.sets, **self.tuning.sets}
        self.trace.clear()
        self.child.start(Plan(**{**vars(plan), "sets": sets}))
        self.tuning.began()

    def end(self) -> None:
        """End the run in good order."""
        if self.child.runs:
            self.child.stop()
        else:
            raise ParameterError("this run was not started here: end it where it was started")

    # Keeping up

    def _keep(self) -> None:
        while not self._ended.wait(KEEP_EVERY):
            try:
                self._look()
                self.notice = self.link.trouble
            except Exception as error:  # what nobody has foreseen must not end the looking
                self.notice = f"{type(error).__name__}: {error}"

    def _follow(self) -> None:
        """Keep up with what only the simulated plant knows."""
        while not self._ended.wait(FOLLOW_EVERY):
            began = self.link.began
            try:
                if len(began) == len(NODES):
                    while self.truth.follow(began, self.link.effects) and not self._ended.is_set():
                        pass
            except Exception as error:  # whatever a foreign node says of itself
                self.truth.lost = f"{type(error).__name__}: {error}"

    def _look(self) -> None:
        self._count(time.monotonic(), self.trace.run, self.trace.end)
        self._rest()
        draft = (self.tuning.changes, self.tuning.base, self.tuning.live)
        if draft != self._judged:
            self._judged = draft
            self.tuning.judge()

    def _count(self, now: float, run: int, end: int) -> None:
        """Find the rate out; the first samples may come late, all at once."""
        seen = self._seen
        if run != self._run or not end:
            self._run, self.rate = run, 0.0
            seen.clear()
        if not end:
            return
        if seen and end != seen[-1][1]:
            self._moved = now
        seen.append((now, end))
        while len(seen) > 2 and seen[1][0] < now - RATE_OVER:
            seen.popleft()
        then, before = seen[0]
        self.rate = (end - before) / max(now - then, 1e-9)

    def _rest(self) -> None:
        """Lay the draft over what runs, or over what would."""
        values = self.link.values
        if self.running:
            if len(values) == len(NODES) and values != self._rested:
                self._rested = {node: dict(each) for node, each in values.items()}
                self.tuning.rest_on(self._rested, live=True)
                self._describe(self._rested)
        elif self._rested is not self.plan:
            self._rested = self.plan
            with contextlib.suppress(ParameterError):
                experiment = self.plan.load()
                found = {node: dict(each.values) for node, each in experiment.nodes.items()}
                self.tuning.rest_on(found, live=False)
                self._describe(found)

    def _describe(self, values: Any) -> None:
        """Period of the reference and limits of the voltage."""
        plant = values["plant"]
        self.limits = plant.get("voltage_min"), plant.get("voltage_max")
        segments = experiment_of(values).segments
        self.period = segments[0].period * plant["T_s"] if len(segments) == 1 else 0.0
