"""The state that all browsers share: one run, one set of values, one history."""

from __future__ import annotations

import contextlib
import threading
import time
from collections import deque
from dataclasses import replace
from pathlib import Path
from typing import Any

from pea_core.config import NAMESPACE, NODES
from pea_core.params import ParameterError
from pea_core.units import NS, SECOND
from pea_dashboard.child import Child, RunPlan
from pea_dashboard.foreign import count, number, plain
from pea_dashboard.link import Link, Told
from pea_dashboard.recording import Recordings, limits_of, permitted_of
from pea_dashboard.stop import Stop
from pea_dashboard.trace import Trace
from pea_dashboard.truth import TruthFollower
from pea_dashboard.tuning import Tuning
from pea_experiment import experiments, rig
from pea_lab.guard import experiment_of
from pea_report.folder import COUNTS

KEEP_EVERY = 0.2
"""Seconds between two looks at what runs."""

FOLLOW_EVERY = 0.04
"""Seconds between two looks at new samples."""

RATE_OVER = 3.0
"""Seconds over which the rate is averaged: samples come in blocks."""

SILENT = 2.0
"""Seconds without a new sample after which a loop stands still."""

DAY = 86_400.0

LOST = "lost_samples"
"""Key of the samples that a node has lost."""

FRESH = 3.0
"""Seconds after which a status that comes once a second is stale."""

BEHIND = 1.0
"""Backlog of the recorder (s) from which on it is a warning."""

NOTHING = ("none", "–")

HEALTH = ("rate", "missed", "lost", "safety", "recorder", "truth", "outcome")
"""Figures of the loop's health."""

Item = tuple[str, str]
"""Level (``none``, ``good``, ``warning``, ``bad``, ``stale``) and text."""


def aged(item: Item, at: float, now: float) -> Item:
    """An item that came `at` a time (s, monotonic): stale, with its age, after `FRESH`."""
    age = now - at
    return item if age < FRESH else ("stale", f"{item[1]}, {age:.0f} s ago")


class Desk:
    """State of the dashboard.

    Parameters
    ----------
    child : Child
        Starts runs.
    attached : bool
        Whether it shows a run that another process has started; it then starts none.
    bag : str
        A recording to open.
    plan : RunPlan
        The next run.
    namespace : str
        Of the loop that is shown.
    axis : str
        The axis that is shown first; empty: see `Link.looked_at`.
    """

    def __init__(
        self,
        child: Child,
        attached: bool,
        bag: str,
        plan: RunPlan,
        namespace: str = NAMESPACE,
        axis: str = "",
    ) -> None:
        self.child = child
        self.attached = attached
        self.tuning = Tuning()
        self.trace = Trace()
        self.link = Link(self.trace, self.tuning.changed, namespace)
        self.link.axis = axis
        self.stop = Stop(child.domain, namespace)
        self.recordings = Recordings(Path("runs"), bag)
        self.experiments = experiments.names()
        self.rigs = rig.names()
        self.plan = plan
        self.period = 0.0
        self.limits: tuple[float, float] | None = None
        self.permitted: tuple[float, ...] = ()
        self.notice = ""
        self.rate = 0.0
        self._seen: deque[tuple[float, int]] = deque()
        self._run = -1
        self.moved = self.counted = 0.0
        self._rested: Any = None
        self._judged: Any = None
        self._ended = threading.Event()
        self.truth = TruthFollower(self.trace)
        self._threads = [
            threading.Thread(target=do, name=name, daemon=True)
            for name, do in (("desk", self._keep), ("truth", self._follow))
        ]
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """End the threads; a run continues."""
        self._ended.set()
        for thread in self._threads:
            thread.join(5.0)
        self.link.close()
        self.stop.close()

    # What runs

    def look_at(self, axis: str | None) -> None:
        """Show the signals and parameters of another axis; loop and stop belong to all axes."""
        if axis and axis != self.link.looked_at:
            self._lay_by()
            self.link.look_at(axis)
            self.tuning.began()

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
            return "running" if self.silent < SILENT else "standing"
        return "starting" if self.child.runs else "idle"

    @property
    def silent(self) -> float:
        """Seconds since the last new sample, at most a day."""
        return min(time.monotonic() - self.moved, DAY)

    @property
    def gate(self) -> tuple[str, str]:
        """State of the plant's safety gate, and its reason; empty where there is none."""
        told = self.link.diagnostics.get("plant: gate")
        if told is None or not self.running:
            return "", ""
        reason = told.values.get("reason", "")
        return told.text, "" if reason == "none" else reason

    def health(self) -> dict[str, Item]:
        """Level and text of each figure of the loop's health; a stale one says its age."""
        if not self.running:
            found = dict.fromkeys(HEALTH, NOTHING)
            level = "bad" if self.child.failed else "none"
            return {**found, "outcome": (level, self.child.outcome or "–")}
        found = {}
        for name in HEALTH:
            try:
                found[name] = getattr(self, f"_{name}")()
            except Exception as error:  # of one of them: the others are shown
                found[name] = ("stale", plain(f"unknown: {error}"))
        return found

    def _rate(self) -> Item:
        T_ns = self.trace.T_ns
        due = SECOND / T_ns if T_ns else 0.0
        item = ("good" if self.rate else "warning", f"{self.rate:,.0f} of {due:,.0f} Hz")
        return aged(item, min(self.counted, self.moved or self.counted), time.monotonic())

    def _missed(self) -> Item:
        told, now = self.link.diagnostics, time.monotonic()
        loop, gate = told.get("loop"), told.get("plant: gate")
        if loop is not None:
            share = number(loop.values.get("missed_fraction", "0"))
            missed = _counted(loop, "missed")
            text = missed if share is None else f"{missed} ({share:.3%})"
            return aged(("warning" if loop.level else "good", text), loop.at, now)
        if gate is not None:
            counts = ", ".join(f"{_counted(gate, name)} {name}" for name in COUNTS)
            return aged(("warning" if gate.level else "good", counts), gate.at, now)
        return NOTHING

    def _lost(self) -> Item:
        told = {n: each for n, each in self.link.diagnostics.items() if LOST in each.values}
        counts = {name: count(each.values[LOST]) for name, each in told.items()}
        odd = [name for name, losses in counts.items() if losses is None]
        if losses := sum(each for each in counts.values() if each):
            return "bad", f"{losses:,}"
        if odd:
            return "warning", f"{odd[0]} says {told[odd[0]].values[LOST]!r}: not a number"
        if self.trace.unseen:
            return "good", f"0 ({self.trace.unseen:,} not seen here)"
        return "good", "0"

    def _safety(self) -> Item:
        told, (state, reason) = self.link.diagnostics.get("plant: gate"), self.gate
        if told is None:
            return "good", "no gate"
        fault = state == "fault"
        item = ("bad", f"{state}: {reason}") if fault else ("good", state or "no gate")
        return aged(item, told.at, time.monotonic())

    def _recorder(self) -> Item:
        """How far the recorder is behind."""
        loop, now = self.link.diagnostics.get("loop"), time.monotonic()
        if loop is not None and "backlog_samples" in loop.values:
            behind, at = count(loop.values["backlog_samples"]), loop.at
        elif self.link.recorded >= 0:
            behind, at = max(self.trace.end - self.link.recorded, 0), self.link.recorded_at
        else:
            return "none", "off"
        if behind is None:
            return "stale", "unknown"
        seconds = behind * self.trace.T_ns * NS
        if seconds < BEHIND:
            return aged(("good", "keeps up"), at, now)
        return aged(("warning", f"{seconds:.1f} s not written yet"), at, now)

    def _outcome(self) -> Item:
        notice = self.notice or self.link.refused
        return "warning" if notice else "none", notice or "–"

    def _truth(self) -> Item:
        return "none", self.truth.lost or "known"

    def start(self) -> None:
        """Start the plan with the draft laid over it.

        Raises
        ------
        ParameterError
            It cannot run, or another one does.
        """
        if self.running:
            raise ParameterError("a loop runs in this ROS domain: stop it first")
        plan = replace(self.plan, sets=self.tuning.over(self.plan.sets))
        self.link.clear()
        self.child.start(plan)
        self.plan = plan
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
                self.notice = plain(f"{type(error).__name__}: {error}")

    def _follow(self) -> None:
        """Keep up with what only the simulated plant knows."""
        while not self._ended.wait(FOLLOW_EVERY):
            began = self.link.began
            try:
                if len(began) == len(NODES):
                    while self.truth.follow(began, self.link.effects) and not self._ended.is_set():
                        pass
            except Exception as error:  # whatever a foreign node says of itself
                self.truth.lost = plain(f"{type(error).__name__}: {error}")

    def _look(self) -> None:
        self._count(time.monotonic(), self.trace.run, self.trace.end)
        self._rest()
        draft = (self.tuning.changes, self.tuning.base, self.tuning.live)
        if draft != self._judged:
            self._judged = draft
            self.tuning.judge()

    def _count(self, now: float, run: int, end: int) -> None:
        """Find the rate out; the first samples may come late, all at once."""
        seen, self.counted = self._seen, now
        if run != self._run or not end:
            self._run, self.rate = run, 0.0
            seen.clear()
        if not end:
            return
        if seen and end != seen[-1][1]:
            self.moved = now
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
            tuned = self.tuning.tuned if self.tuning.live else {}
            self._lay_by()
            self._rested = self.plan
            with contextlib.suppress(ParameterError):
                each = {one.axis: one for one in self.plan.load().each}
                experiment = each.get(self.link.axis) or next(iter(each.values()))
                found = {node: dict(own.values) for node, own in experiment.nodes.items()}
                self.tuning.rest_on(found, live=False)
                self._describe(found)
            if tuned:
                self.tuning.keep(tuned)

    def _lay_by(self) -> None:
        """Have what was tuned on one of several axes count for that axis in the next run."""
        if self.tuning.live and self.link.several:
            axis = self.link.looked_at
            told = {
                f"{node}.{axis}.{name}": value
                for node, values in self.tuning.tuned.items()
                for name, value in values.items()
            }
            self.plan = replace(self.plan, sets={**self.plan.sets, **told})

    def _describe(self, values: Any) -> None:
        """Period of the reference, limits of the voltage, corners of the permitted area."""
        self.limits = limits_of(values["plant"])
        self.permitted = permitted_of(values["plant"])
        self.period = 0.0
        segments = experiment_of(values).segments
        if len(segments) == 1:
            T_s = number(values["plant"].get("T_s")) or 0.0
            self.period = number(segments[0].period * T_s) or 0.0


def _counted(told: Told, name: str) -> str:
    """A count that a node has said, for people."""
    found = count(told.values.get(name, "0"))
    return "?" if found is None else f"{found:,}"
