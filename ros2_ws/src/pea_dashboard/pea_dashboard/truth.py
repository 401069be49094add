"""What only a simulated plant knows: a second one, driven with the commands of the loop.

A simulation repeats itself to the bit. So a plant made anew, that is told every command, has the
states of the loop's; where commands did not come here, the loop itself is simulated up to the first
that did, with the changes of its parameters at the samples where they took effect. Its y is
compared with the y that came, sample by sample: where it differs (the plant's parameters were
changed, or it is a device) nothing is shown.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from pea_core.loop import Loop, blocks_of
from pea_dashboard.trace import Trace
from pea_engine.compiled import WORTH, wanted
from pea_engine.kernels import drive_kernel
from pea_experiment.experiment import Experiment
from pea_experiment.metrics import unknown_input
from pea_lab.guard import experiment_of
from pea_plant import drivers
from pea_report.replay import retune

AT_ONCE = 20_000
"""Samples followed at a time."""

LATE = 2**26
"""Samples of a loop that are simulated at most, to find the state of its plant."""


class Effect(NamedTuple):
    """New parameters of a node in the loop.

    Attributes
    ----------
    k : int
        First sample that goes by them.
    role : str
    values : dict
    """

    k: int
    role: str
    values: dict[str, Any]


class TruthFollower:
    """Follows a loop.

    Parameters
    ----------
    trace : Trace
        Where samples come from, and `eps` goes.

    Attributes
    ----------
    lost : str
        Why the truth of this run cannot be known; empty where it can.
    """

    def __init__(self, trace: Trace) -> None:
        self.trace = trace
        self.lost = ""
        self._run = -1
        self._joins = 0
        self._desired: Any = None
        self._plant: Any = None
        self._kernel: Any = None
        self._experiment: Experiment | None = None
        self._k = 0

    def follow(
        self, values: Mapping[str, Mapping[str, object]], effects: Sequence[Effect] = ()
    ) -> bool:
        """Go on with the samples that have come; whether there were any.

        Parameters
        ----------
        values : mapping of str to mapping
            Values of the four nodes at the start.
        effects : sequence of Effect
            What they have become since.
        """
        run = self.trace.run
        if run != self._run:
            self._run, self._plant, self.lost, self._joins = run, None, "", 0
            self._desired = None
        if not self.trace.end:
            return False
        self._desire(values)
        if self.lost:
            return False
        if self._plant is None:
            self._join(experiment_of(values), effects)
        if self.lost:
            return False
        start = self._k
        table = self.trace.samples(start, start + AT_ONCE, "y", "u", "u_applied")
        n = len(table["k"])
        if not n:
            return False
        if table["k"][0] != start or not np.isfinite(table["u"]).all():
            self._plant = None  # some have not come: anew from behind them
            return True
        y, x1, x2, x2_dot = self._drive(np.ascontiguousarray(table["u"])).T
        self._k += n
        if not np.array_equal(y, table["y"]):
            self.lost = f"y differs from the simulation's at sample {start} or soon after"
            return False
        assert self._experiment is not None
        eps = unknown_input(self._experiment.nominal, x1, x2, x2_dot, table["u_applied"])
        self.trace.fill(run, table["k"], "eps", eps)
        return True

    def _desire(self, values: Mapping[str, Mapping[str, object]]) -> None:
        """Find out the reference of samples for which it was sent before somebody listened."""
        trace = self.trace
        table = trace.samples(trace.first, trace.first + AT_ONCE, "w")
        unknown = table["k"][np.isnan(table["w"])]
        if len(unknown) and not self._desired:
            self._desired = experiment_of(values).loop().reference
        if len(unknown):
            w = [self._desired.at(k).w for k in unknown.tolist()]
            trace.fill(self._run, unknown, "w", np.array(w))

    def _join(self, experiment: Experiment, effects: Sequence[Effect]) -> None:
        """Bring a plant to the first sample that is there."""
        first = self.trace.unbroken
        self._joins += 1
        simulated = isinstance(experiment.nodes["plant"].params.driver, drivers.Simulated)
        if not simulated:
            self.lost = "the plant is a device"
        elif self._joins * first > LATE:
            self.lost = "too far from the start of the run"
        if self.lost:
            return
        loop = experiment.loop(wanted(first))
        for k, role, values in [e for e in effects if e.k < first]:
            _run(loop, k)
            retune(getattr(loop, role), role, values)
        _run(loop, first)
        self._plant, self._experiment, self._k = loop.plant, experiment, first
        self._kernel = drive_kernel(self._plant.model) if wanted(WORTH) else None

    def _drive(self, u: np.ndarray) -> np.ndarray:
        """y, x1, x2, x2' (SI) at the next samples, one a row."""
        plant = self._plant
        seen = np.empty((len(u), 4))
        if self._kernel is not None:
            plant.s = self._kernel(plant.c, plant.s, plant.noise(len(u)), u, seen)
            return seen
        for i, u_k in enumerate(u.tolist()):
            seen[i] = (plant.read().y, *plant.truth)
            plant.write(u_k)
        return seen


def _run(loop: Loop, end: int) -> None:
    """Run a loop up to a sample."""
    for samples in blocks_of(end - loop.k, loop.piece):
        loop.run(samples)
