"""Plans of measurements: an experiment for each, checked before anything moves.

The reference moves softly to the operating point, makes the motion of the measurement, and moves
softly back. In open loop the law is `open_loop`, u = w/K, so that levels in um are voltages times
K.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from pea_controller.model import CHOICE as LAWS
from pea_core.config import node_specs
from pea_core.params import ParameterError
from pea_experiment import experiments
from pea_experiment.experiment import Experiment
from pea_plant.gate import soft_rate
from pea_plant.model.actuator import steady_state_gain
from pea_reference.model import levels

KINDS = ("loop", "response", "steps", "hysteresis", "creep", "noise")

OPEN = (
    "controller.type=open_loop",
    "controller.feedforward=false",
    "controller.eps_compensation=false",
    "controller.preview_samples=0",
)
"""Settings for open loop, with the voltage w/K."""

OPEN_LOOP = {"type": "open_loop"}
NODES_OF_LOOP = ("observer", "controller")

SPEED = 0.25
"""Share of the slew limit that a soft move uses."""

MOVE = 0.2
"""Least time of a soft move (s)."""

SETTLE = 0.2
"""Rest after a soft move (s)."""


class Reach(NamedTuple):
    """Limits of a stage: displacements (um), change of w (um/s, inf: any), soft start (s)."""

    low: float
    high: float
    rate: float
    soft_start: float

    @property
    def stroke(self) -> float:
        """Difference of both limits (um)."""
        return self.high - self.low


@dataclass(frozen=True)
class PlannedMeasurement:
    """A measurement that can be run.

    Attributes
    ----------
    kind : str
        One of `KINDS`.
    experiment : Experiment
        The experiment to run.
    settings : dict
        Data for the analysis.
    """

    kind: str
    experiment: Experiment
    settings: dict[str, Any] = field(default_factory=dict)

    def announced(self) -> str:
        """One line on what will move."""
        w = self.experiment.nodes["reference"].params
        low, high = min(w.start_um, *w.levels_um), max(w.start_um, *w.levels_um)
        law = "open loop" if self.settings["open"] else "closed loop"
        told = f"{self.kind}: {law}, {low:.4g} to {high:.4g} um"
        inject = self.experiment.nodes["controller"].params.inject
        if inject.where == "voltage":
            told += f", test signal {inject.amplitude_V:g} V"
        elif inject.where == "reference":
            told += f", test signal {inject.amplitude_um:g} um"
        return f"{told}, {self.experiment.about.duration:.4g} s"


def reach(experiment: Experiment) -> Reach:
    """Limits of the stage of an experiment."""
    plant = experiment.nodes["plant"].params
    K = steady_state_gain(plant)
    ends = sorted((plant.voltage_min * K, plant.voltage_max * K))
    low = max(ends[0], plant.safety.displacement_min_um)
    high = min(ends[1], plant.safety.displacement_max_um)
    rates = [r for r in (plant.safety.slew_rate, plant.amplifier.slew_rate) if r > 0.0]
    slow = soft_rate(plant.safety)
    far = max(abs(plant.voltage_min), abs(plant.voltage_max))
    return Reach(
        low, high, min(rates, default=math.inf) * abs(K), far / slow + 0.1 if slow else 0.0
    )


def soft(way: float, allowed: Reach) -> float:
    """Time (s) of a soft move by `way` (um)."""
    steepest = 1.875  # of a minimum-jerk move, over its mean
    by_rate = steepest * abs(way) / (SPEED * allowed.rate) if allowed.rate < math.inf else 0.0
    return max(MOVE, by_rate)


class Way:
    """A sequence of levels of the reference, with moves and holds.

    Parameters
    ----------
    allowed : Reach
    """

    def __init__(self, allowed: Reach) -> None:
        self.allowed = allowed
        self.levels: list[float] = [0.0]
        self.moves: list[float] = [0.0]
        self.holds: list[float] = [allowed.soft_start]

    @property
    def time(self) -> float:
        """Length so far (s)."""
        return sum(self.moves) + sum(self.holds)

    @property
    def last(self) -> int:
        """Index of the last level."""
        return len(self.levels) - 1

    def to(self, level: float, hold: float, move: float | None = None) -> int:
        """Add a level, and return its index; without `move` (s) the move is a soft one."""
        self.moves.append(soft(level - self.levels[-1], self.allowed) if move is None else move)
        self.levels.append(level)
        self.holds.append(hold)
        return self.last

    def sets(self, shape: str = "minimum_jerk") -> list[str]:
        """Settings of the reference, and the duration."""

        def listed(values: Sequence[float]) -> str:
            return "[" + ", ".join(f"{float(v):.12g}" for v in values) + "]"

        return [
            "reference.type=levels",
            "reference.start_um=0",
            f"reference.levels_um={listed(self.levels)}",
            f"reference.move_s={listed(self.moves)}",
            f"reference.hold_s={listed(self.holds)}",
            f"reference.shape={shape}",
            f"experiment.duration={self.time:.12g}",
        ]


class Base(NamedTuple):
    """Base of a measurement: experiment, settings of the user, rig."""

    name: str
    sets: tuple[str, ...] = ()
    rig: str | None = None

    def load(self, more: Sequence[str] = ()) -> Experiment:
        """The experiment with the settings of the measurement; those of the user override them.

        In open loop the settings of the user's law are omitted, because that law does not run.
        Levels become voltages by the gain of the plant, as in the check of the limits.
        """
        sets = self.sets
        if OPEN[0] in more:
            own = {each.partition("=")[0] for each in OPEN} | {"controller.preset", "controller.K"}
            served = {f"controller.{name}" for name in node_specs(LAWS, OPEN_LOOP)} - own
            sets = tuple(
                each
                for each in sets
                if not each.startswith("controller.") or each.partition("=")[0].strip() in served
            )
            plant = experiments.load(self.name, [*more, *sets], rig=self.rig).nodes["plant"].params
            more = [*more, f"controller.K={steady_state_gain(plant):.17g}"]
        return experiments.load(self.name, [*more, *sets], rig=self.rig)

    @property
    def chooses_law(self) -> bool:
        """Whether the user has named a law or an observer."""
        names = {each.partition("=")[0].strip() for each in self.sets}
        return bool(
            names & {f"{node}.{way}" for node in NODES_OF_LOOP for way in ("type", "preset")}
        )


def within(name: str, value: float, low: float, high: float, unit: str = "um") -> None:
    """Refuse a value outside a range.

    Raises
    ------
    ParameterError
        The value is outside.
    """
    if not low <= value <= high:
        raise ParameterError(
            f"{name} {value:g} {unit}: outside what the stage allows, {low:.4g} to {high:.4g} "
            f"{unit}; give a value within"
        )


def looked_ahead(
    kind: str, base: Base, sets: Sequence[str], **settings: object
) -> PlannedMeasurement:
    """The measurement, checked against the limits of the stage.

    Raises
    ------
    ParameterError
        A level is outside the stroke, or a move is faster than the slew limit.
    """
    experiment = base.load(sets)
    allowed, w = reach(experiment), experiment.nodes["reference"].params
    if not isinstance(w, levels.Params):
        raise ParameterError(
            f"reference.type = {experiment.nodes['reference'].values['type']!r}: a measurement "
            "moves by its own reference; omit it"
        )
    inject = experiment.nodes["controller"].params.inject
    plant = experiment.nodes["plant"].params
    beyond = {
        "off": 0.0,
        "reference": inject.amplitude_um,
        "voltage": inject.amplitude_V * abs(steady_state_gain(plant)),
    }[inject.where]
    for level in w.levels_um:
        around = beyond if level != 0.0 else 0.0
        within("level", level, allowed.low + around, allowed.high - around)
    steepest = 1.875 if w.shape == "minimum_jerk" else 1.0
    before = w.start_um
    for level, move in zip(w.levels_um, np.broadcast_to(w.move_s, len(w.levels_um)), strict=True):
        rate = steepest * abs(level - before) / move if move > 0.0 else 0.0
        if rate > allowed.rate * (1.0 + 1e-9):
            raise ParameterError(
                f"move from {before:g} to {level:g} um in {move:g} s: {rate:.4g} um/s, the slew "
                f"limit allows {allowed.rate:.4g} um/s; give it more time"
            )
        before = level
    return PlannedMeasurement(kind, experiment, settings)


def middle(base: Base, at: float | None, more: Sequence[str] = ()) -> tuple[Reach, float]:
    """Limits of the stage, and the operating point (um): `at`, or the middle of the stroke."""
    allowed = reach(base.load(["reference.type=constant", *more]))
    if at is None:
        return allowed, round(0.5 * (allowed.low + allowed.high), 3)
    within("--at", at, allowed.low, allowed.high)
    return allowed, at


def resting(base: Base, at: float | None) -> tuple[Reach, float]:
    """The same in open loop; the default point is the rest position, where nothing creeps."""
    allowed, level = middle(base, at, OPEN)
    return allowed, level if at is not None else min(max(0.0, allowed.low), allowed.high)


def injected(base: Base, kind: str, at: float | None, inject: dict[str, Any]) -> PlannedMeasurement:
    """A test signal at an operating point, in closed loop, or (``response``) in open loop."""
    more = list(OPEN) if kind == "response" else []
    allowed, level = middle(base, at, more)
    T_s = base.load(["reference.type=constant", *more]).T_s
    way = Way(allowed)
    way.to(level, SETTLE)
    values = {"where": "voltage", **inject, "wait": round(way.time / T_s) * T_s}
    nyquist = 0.5 / T_s
    values.setdefault("to_hz", min(2000.0, 0.4 / T_s) if kind == "loop" else 0.8 * nyquist)
    values.setdefault("from_hz", min(10.0, values["to_hz"] / 20.0))
    values.setdefault("period", max(0.1, 1.0 / values["from_hz"]))
    sets = [*more, *(f"controller.inject.{name}={value}" for name, value in values.items())]
    params = base.load([*sets, "reference.type=constant"]).nodes["controller"].params
    from pea_core.injection import plan

    way.holds[-1] += (plan(params.inject, T_s).samples * T_s) - values["wait"] + 0.05
    way.to(0.0, 0.05)
    return looked_ahead(
        kind, base, [*way.sets(), *sets], at_um=level, open=kind == "response", start=0
    )


def steps(
    base: Base, at: float | None, sizes: Sequence[float], repeats: int, hold: float, open_: bool
) -> PlannedMeasurement:
    """Steps of several sizes up and down about an operating point, repeated."""
    more = list(OPEN) if open_ else []
    allowed, level = middle(base, at, more)
    way, made = Way(allowed), []
    way.to(level, SETTLE)
    for size in sizes:
        within("--sizes", abs(size), 1e-9, allowed.stroke)
        fast = 1.1 * abs(size) / allowed.rate if allowed.rate < math.inf else 0.0
        for _ in range(repeats):
            made += [(way.to(level + size, hold, fast), size), (way.to(level, hold, fast), -size)]
    way.to(0.0, 0.05)
    return looked_ahead(
        "steps", base, [*way.sets("linear"), *more], at_um=level, open=open_, steps=made
    )


def hysteresis(
    base: Base,
    low: float | None,
    high: float | None,
    period: float,
    loops: int,
    shape: str = "linear",
) -> PlannedMeasurement:
    """Slow triangles of the voltage: major loops over a range, then minor loops within it.

    With the shape ``minimum_jerk`` they turn softly and excite no mode.
    """
    allowed = middle(base, None, OPEN)[0]
    bottom = allowed.low + 0.05 * allowed.stroke if low is None else low
    top = allowed.high - 0.05 * allowed.stroke if high is None else high
    within("--from", bottom, allowed.low, allowed.high)
    within("--to", top, bottom, allowed.high)
    way = Way(allowed)
    way.to(bottom, SETTLE)
    major, minor = [], []
    for _ in range(loops + 1):  # the first one wipes out the earlier memory
        major += [(way.to(top, 0.0, period / 2.0), way.to(bottom, 0.0, period / 2.0))]
    centre, half = 0.5 * (bottom + top), 0.5 * (top - bottom)
    way.to(centre, 0.0, period / 4.0)
    for share in (0.5, 0.25, 0.1):
        ends = (centre + share * half, centre - share * half)
        for _ in range(2):
            way.to(ends[1], 0.0, share * period / 2.0)
            minor.append((way.to(ends[0], 0.0, share * period / 2.0), share))
    way.to(0.0, 0.05, soft(centre, allowed) * 2.0)
    return looked_ahead(
        "hysteresis",
        base,
        [*way.sets(shape), *OPEN],
        open=True,
        major=major,
        minor=minor,
        from_um=bottom,
        to_um=top,
    )


def creep(
    base: Base, at: float | None, size: float | None, hold: float, move: float = 0.0
) -> PlannedMeasurement:
    """A small step of the voltage and a hold; with `move` (s) the step is a soft move."""
    allowed, level = resting(base, at)
    size = 0.1 * allowed.stroke if size is None else size
    way = Way(allowed)
    way.to(level, SETTLE)
    fast = 1.1 * abs(size) / allowed.rate if allowed.rate < math.inf else 0.0
    step = way.to(level + size, hold, max(move, 1.875 * fast) if move else fast)
    way.to(0.0, 0.05)
    sets = [*way.sets("minimum_jerk" if move else "linear"), *OPEN]
    return looked_ahead("creep", base, sets, at_um=level, open=True, step=step, size_um=size)


def noise(base: Base, at: float | None, duration: float, open_: bool) -> PlannedMeasurement:
    """A hold at an operating point."""
    more = list(OPEN) if open_ else []
    allowed, level = resting(base, at) if open_ else middle(base, at)
    way = Way(allowed)
    still = way.to(level, SETTLE + duration)
    way.to(0.0, 0.05)
    sets = [*way.sets(), *more]
    return looked_ahead("noise", base, sets, at_um=level, open=open_, still=still, begin_s=SETTLE)
