"""Whether a loop comes to rest after raw steps, with its limits and its hysteresis.

Poles and margins are of the linear loop. Limits, slew rate and hysteresis can keep an oscillation
alive that the linear loop would damp: a limit cycle. So the loop itself is run from rest into raw
steps of several sizes, without noise, and what is left at the end is looked at.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from pea_controller import model as controller
from pea_core.injection import InjectParams
from pea_core.loop import Loop, LoopFault, blocks_of, trace
from pea_core.params import ParameterError
from pea_core.signals import Reference
from pea_core.units import NM_PER_M
from pea_experiment.checks import LOOKS
from pea_experiment.experiment import Experiment
from pea_plant.model import hysteresis, load
from pea_plant.model.actuator import steady_state_gain
from pea_reference.shaped import jumps, moves

FEW = (0.575, 0.3, 0.06)
"""Steps, as a share of the stroke, the displacement at voltage_max: 0.1 s of work."""

MANY = (0.65, 0.575, 0.5, 0.4, 0.3, 0.15, 0.06)
"""The same where there is more time: a limit cycle may need a step of its own size."""

SAMPLES = 900
"""Length of each look: 45 ms at 20 kHz."""

WINDOW = 250
"""Samples at the end that are compared with as many before."""

SHARE = 0.006
"""Least oscillation that counts, as a share of the stroke."""

DECAYS = 0.7
"""An oscillation that falls below this share from window to window comes to rest."""


HELD_S, ALLOWED_NM, ALLOWED_SHARE = 0.3, 50.0, 0.01
"""Allowed error after a raw step through a slew limit: when (s), at least (nm), of the step."""

LAST_S = 0.01
"""How long that error is looked at (s)."""

LEAD_S = 0.02
"""How long before a raw step such a run begins (s)."""


class Oscillation(NamedTuple):
    """What was left after a step.

    Attributes
    ----------
    step_um : float
        The step, from rest (um).
    rms_nm : float
        Rms of the oscillation at the end (nm); infinite where the loop could not go on.
    """

    step_um: float
    rms_nm: float

    def __str__(self) -> str:
        return (
            f"keeps oscillating by {self.rms_nm:.3g} nm rms after a step of {self.step_um:.3g} um "
            "(seen in a run with limits and hysteresis)"
        )


class Level:
    """A reference that is at one displacement (m) from sample 0 on."""

    def __init__(self, level: float) -> None:
        self.point = Reference(level, 0.0, 0.0)

    def at(self, k: int) -> Reference:
        """The same at every sample."""
        return self.point


class Held:
    """A reference from sample `begin` on, held at its level from sample `jump` on."""

    def __init__(self, signal: Any, begin: int, jump: int) -> None:
        self.signal, self.begin, self.jump = signal, begin, jump

    def at(self, k: int) -> Reference:
        """Reference at sample k of the run."""
        found: Reference = self.signal.at(min(self.begin + k, self.jump))
        return found


class Turn:
    """A reference at one level (m) before a sample, and at another from there on."""

    def __init__(self, before: float, after: float, jump: int) -> None:
        self.before, self.after = Reference(before, 0.0, 0.0), Reference(after, 0.0, 0.0)
        self.jump = jump

    def at(self, k: int) -> Reference:
        """Reference at sample k of the run."""
        return self.before if k < self.jump else self.after


def quiet(experiment: Experiment) -> Experiment:
    """The experiment from rest, without noise, load and test signal, its gate but the slew rate."""
    node = experiment.nodes["plant"]
    given = node.params
    params = dataclasses.replace(
        given,
        x10_um=0.0,
        x20_um_s=0.0,
        sensor=dataclasses.replace(given.sensor, noise_nm=0.0),
        load=load.none.Params(),
        safety=type(given.safety)(slew_rate=given.safety.slew_rate),
    )
    law = experiment.nodes["controller"]
    own = dataclasses.replace(law.params, inject=InjectParams())
    nodes = {"plant": node._replace(params=params), "controller": law._replace(params=own)}
    return dataclasses.replace(experiment, nodes={**experiment.nodes, **nodes})


def unslewed(experiment: Experiment) -> str:
    """Say that a law switches by more than the actuator can follow in a sample; else empty."""
    params = experiment.nodes["controller"].params
    type_ = controller.CHOICE.type_of(params)
    switching = getattr(controller.MODELS[type_], "switching", None)
    change = params.slew_rate * experiment.T_s
    if switching is None or change == 0.0 or switching(params) <= change:
        return ""
    return (
        f"controller.type = {type_!r} switches by {switching(params):g} V from sample to sample, "
        f"and controller.slew_rate leaves {change:g} V: it cannot hold w; take "
        "smc_boundary_layer or pidsmc"
    )


def follows(experiment: Experiment) -> float:
    """Largest jump of w (m) that the actuator follows within a sample."""
    change = experiment.nodes["controller"].params.slew_rate * experiment.T_s
    return float(change * steady_state_gain(experiment.nodes["plant"].params) * 1e-6)


def raw_steps(experiment: Experiment) -> dict[int, float]:
    """Samples at which w jumps by more than the actuator slews, and rests then; the jumps (m)."""
    rest = experiment.nodes["plant"].params.x10_um * 1e-6
    samples = min(experiment.samples, LOOKS)
    return jumps(experiment.loop().reference, samples, rest, follows(experiment))


def raw_turn(before: Experiment, after: Experiment) -> tuple[float, float] | None:
    """Levels (m) between which w jumps the farthest where one reference takes another's place.

    None where it moves from one to the other, or jumps by no more than the actuator slews.
    """
    params = after.nodes["reference"].params
    if moves(params):
        return None
    old, new = before.loop().reference, after.loop().reference
    ways = []
    for k in range(min(after.samples, LOOKS)):
        to = new.at(k)
        if to.w_dot == 0.0 and to.w_ddot == 0.0:
            ways.append((old.at(k).w, to.w))
    found = max(ways, key=lambda way: abs(way[1] - way[0]), default=(0.0, 0.0))
    return found if abs(found[1] - found[0]) > follows(after) else None


def called(experiment: Experiment) -> str:
    """Name of the experiment, and of the axis where it is one of several."""
    several = len(experiment.nodes["plant"].node.axes) > 1
    return f"{experiment.name}: axis {experiment.axis}" if several else experiment.name


def refuse_steps(experiment: Experiment) -> None:
    """Refuse a raw step through a slew limit after which the law does not hold w.

    Raises
    ------
    ParameterError
        Too much error is left; the text says how much.
    """
    if text := unheld(experiment):
        raise ParameterError(f"{called(experiment)}: {text}, or run it all the same with --force")


def unheld(experiment: Experiment, running: Experiment | None = None) -> str:
    """Say that a law does not hold w after a raw step through a slew limit; else empty.

    The largest step is simulated, with limits and hysteresis and without noise.

    Parameters
    ----------
    experiment : Experiment
    running : Experiment, optional
        What runs already: its reference turns into the new one while the loop runs.
    """
    law = experiment.nodes["controller"].params
    if law.slew_rate == 0.0:
        return ""
    still, steps = quiet(experiment), raw_steps(experiment)
    lead = round(LEAD_S / experiment.T_s)
    ways: dict[float, tuple[Any, int]] = {}
    if running is not None:
        steps.pop(0, None)  # at the begin of a run, which is past
        if turn := raw_turn(running, experiment):
            ways[abs(turn[1] - turn[0])] = Turn(*turn, lead), lead
    if steps:
        jump = max(steps, key=lambda k: abs(steps[k]))
        lead = min(jump, lead)
        ways[abs(steps[jump])] = Held(still.loop().reference, jump - lead, jump), lead
    if not ways:
        return ""
    size = max(ways)
    left = _held(still, *ways[size])
    allowed = max(ALLOWED_NM, ALLOWED_SHARE * size * 1e9)
    if left <= allowed:
        return ""
    return (
        f"controller.type = {controller.CHOICE.type_of(law)!r}: a raw step of {size * 1e6:.4g} um "
        f"under controller.slew_rate = {law.slew_rate:g} V/s leaves {left:.3g} nm after "
        f"{HELD_S:g} s, allowed are {allowed:.4g}; take a law with integral action, as the preset "
        "recommended"
    )


def _held(experiment: Experiment, reference: Any, lead: int) -> float:
    """Largest error (nm) once w has been held for `HELD_S` after it jumps at sample `lead`."""
    T_s = experiment.T_s
    made = experiment.loop()
    loop = Loop(made.plant, made.observer, made.controller, reference, T_s)
    begin = lead + round(HELD_S / T_s)
    samples = begin + max(round(LAST_S / T_s), 1)
    try:
        rows = trace([loop.run(n) for n in blocks_of(samples)])
    except (LoopFault, OverflowError):
        return float("inf")
    e = rows["y"][begin:] - rows["w"][begin:]
    if len(rows["y"]) < samples or not np.isfinite(e).all():
        return float("inf")
    return float(np.abs(e).max()) * NM_PER_M


def oscillation(experiment: Experiment, shares: Sequence[float] = FEW) -> Oscillation | None:
    """The largest oscillation that a step leaves, or None where the loop comes to rest.

    Parameters
    ----------
    experiment : Experiment
        Its plant as given; its reference does not count.
    shares : sequence of float
        Steps, as a share of the stroke.
    """
    still = quiet(experiment)
    plant = still.nodes["plant"].params
    K = steady_state_gain(plant)
    stroke = max(plant.voltage_max * K, -plant.voltage_min * K)
    if plant.voltage_max < -plant.voltage_min:
        stroke = -stroke
    found = []
    for share in shares:
        left = _left(still, share * stroke)
        if left > abs(SHARE * stroke) * 1e3:
            found.append(Oscillation(share * stroke, left))
    return max(found, key=lambda seen: seen.rms_nm, default=None)


def _left(experiment: Experiment, step_um: float) -> float:
    """Rms (nm) of an oscillation that does not decay after a step; 0 where there is none."""
    made = experiment.loop()
    level: Any = Level(step_um * 1e-6)
    loop = Loop(made.plant, made.observer, made.controller, level, experiment.T_s)
    try:
        rows = trace([loop.run(n) for n in blocks_of(SAMPLES)])
    except (LoopFault, OverflowError):
        return float("inf")
    y = rows["y"]
    if len(y) < SAMPLES or not np.isfinite(y).all():
        return float("inf")
    t = np.arange(WINDOW)
    before, last = (
        float(np.std(part - np.polyval(np.polyfit(t, part, 1), t)))
        for part in (y[-2 * WINDOW : -WINDOW], y[-WINDOW:])
    )
    return last * NM_PER_M if last > DECAYS * before else 0.0


OFF = 0.1
"""By what share K and omega_n of the other plants are off."""


def plants(experiment: Experiment) -> dict[str, Experiment]:
    """The plant as given, with K and omega_n 10 % off, and with every other hysteresis model."""
    node = experiment.nodes["plant"]
    changes: dict[str, dict[str, Any]] = {"as given": {}}
    for name in ("K", "omega_n"):
        for share in (-OFF, OFF):
            value = getattr(node.params, name) * (1.0 + share)
            changes[f"{name} {100.0 * share:+.0f} %"] = {name: value}
    for kind in hysteresis.PRESENT:
        params = hysteresis.CHOICE.kinds[kind]
        if params is not type(node.params.hysteresis):
            changes[f"hysteresis {kind}"] = {"hysteresis": params()}
    return {
        name: dataclasses.replace(
            experiment,
            nodes={
                **experiment.nodes,
                "plant": node._replace(params=dataclasses.replace(node.params, **change)),
            },
        )
        for name, change in changes.items()
    }


def looks(experiment: Experiment) -> dict[str, Oscillation | None]:
    """What raw steps leave on each of `plants`."""
    return {
        name: oscillation(there, FEW if name != "as given" else MANY)
        for name, there in plants(experiment).items()
    }
