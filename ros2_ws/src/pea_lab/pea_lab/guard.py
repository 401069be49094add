"""Gains that make a loop unstable, or nearly so, are refused before they are taken.

Judged are the margins of gain, delay, modulus and phase, which `check` defines, on the nominal
plant, and whether the loop comes to rest after raw steps with its limits and its hysteresis
(`settling`). A reference is judged by whether the law holds it after a raw step.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from pea_core.axes import per_axis
from pea_core.config import AXIS, NodeParams, Resolved, node_specs, own_of, resolve
from pea_core.params import ParameterError, flatten
from pea_experiment.experiment import SCHEMAS, Experiment, ExperimentParams
from pea_lab.check import (
    GAINS,
    ROUNDING,
    crossings,
    delay_margin,
    modulus_margin,
    phase_margin,
    radius,
)
from pea_lab.linear import Nonlinear, assemble, blocks
from pea_lab.settling import oscillation, unheld

STEP = 0.01
"""Steps of the gain, as a share of it, in which a margin is looked for; it is told so exactly."""

WORSE = 1e-6
"""By how much a margin must fall to be worse."""

SAME = 0.05
"""By how much an oscillation may grow that was there before."""


class Margins(NamedTuple):
    """How far a loop is from instability; see `check` for what each of them is.

    Attributes
    ----------
    command : float
        Gain margin at the command; below 1 for an unstable loop, 0 where no gain makes it stable.
    actuator : float
        Gain margin at the actuator; of an unstable loop that at the command.
    delay : float
        How many samples later u may come; 0 for an unstable loop, infinite where none does harm.
    modulus, phase : float
        Modulus margin, infinite where ``tuning.modulus_margin`` asks for none, and phase margin
        (deg), likewise.
    """

    command: float
    actuator: float
    delay: float
    modulus: float = math.inf
    phase: float = math.inf

    @property
    def gain(self) -> float:
        """The gain margin: the smaller of both."""
        return min(self.command, self.actuator)

    @property
    def place(self) -> str:
        """Where the gain margin is the smaller one."""
        return "actuator" if self.actuator < self.command else "command"


BOUNDLESS = Margins(math.inf, math.inf, math.inf)
"""Of a loop that has no margins."""


def margin(largest: Callable[[float], float], enough: float) -> float:
    """Gain margin of a loop, looked for up to `enough`.

    Parameters
    ----------
    largest : callable
        Largest |z| at a gain.
    enough : float
    """

    def stable(gain: float) -> bool:
        return largest(gain) < 1.0 + ROUNDING

    if not stable(1.0):
        steps = np.exp(-STEP * np.arange(1.0, math.log(GAINS) / STEP))
        return next((float(gain) for gain in steps if stable(gain)), 0.0)
    last = 1.0
    for gain in np.append(np.exp(STEP * np.arange(1.0, math.log(enough) / STEP)), enough):
        if not stable(gain) or not stable(1.0 / gain):
            return last
        last = float(gain)
    return last


def margins(experiment: Experiment, enough: float) -> Margins:
    """Margins of a loop, those of the gain looked for up to `enough`; `BOUNDLESS` if nonlinear."""
    try:
        parts = blocks(experiment)
    except Nonlinear:
        return BOUNDLESS
    loop = assemble(parts)
    command = margin(lambda gain: radius(loop.closed(gain)), enough)
    if command < 1.0:
        return Margins(command, command, 0.0, 0.0, 0.0)
    actuator = margin(lambda gain: radius(assemble(parts, gain).closed()), enough)
    at = crossings(loop)
    delay, phase = (math.inf if x is None else x for x in (delay_margin(at), phase_margin(at)))
    asked = experiment.nodes["controller"].params.tuning.modulus_margin > 0.0
    modulus = modulus_margin(loop) if asked else math.inf
    return Margins(command, actuator, delay, modulus, phase)


def altered(experiment: Experiment, changes: Mapping[str, object]) -> Experiment:
    """The experiment with other parameters of some of its nodes."""
    nodes = dict(experiment.nodes)
    for name, params in changes.items():
        node = nodes[name].node
        values = {**flatten(NodeParams, node), **flatten(SCHEMAS[name], params)}
        nodes[name] = Resolved(node, params, values)
    return dataclasses.replace(experiment, nodes=nodes)


def judge(
    experiment: Experiment,
    changes: Mapping[str, object],
    running: Mapping[str, object] | None = None,
) -> str | None:
    """Say what is wrong with a set of parameters, or None.

    Parameters
    ----------
    experiment : Experiment
        The plant, and every node that nothing else is said of.
    changes : mapping of str to dataclass
        Parameters of the nodes that shall be changed, together.
    running : mapping of str to dataclass, optional
        Parameters that the loop has: what is no worse than they are is never wrong.

    Returns
    -------
    str or None
        For example ``gain margin 0.8 < 1.3 at T_s 50 us (at the actuator)``, or that the loop
        keeps oscillating after a step. A law or an observer that is not linear has no margins, and
        is judged by its steps alone.
    """
    before = altered(experiment, running or {})
    after = altered(before, changes)
    tuning = after.nodes["controller"].params.tuning
    found = margins(after, tuning.gain_margin)
    had = margins(before, tuning.gain_margin) if running is not None else BOUNDLESS
    for name, unit, now, then, enough, place in (
        ("gain", "", found.gain, had.gain, tuning.gain_margin, f" (at the {found.place})"),
        ("delay", " samples", found.delay, had.delay, tuning.delay_margin, ""),
        ("modulus", "", found.modulus, had.modulus, tuning.modulus_margin, ""),
        ("phase", " deg", found.phase, had.phase, tuning.phase_margin, ""),
    ):
        if now < min(enough, then - WORSE):
            told = f"{math.floor(now * 100.0) / 100.0:g} < {enough:g}{unit}"
            return f"{name} margin {told} at T_s {experiment.T_s * 1e6:g} us{place}"
    seen = oscillation(after)
    if seen is None:
        return None
    was = oscillation(before) if running is not None else None
    return None if was is not None and seen.rms_nm <= was.rms_nm * (1.0 + SAME) else str(seen)


def guard(
    experiment: Experiment,
    running: Mapping[str, Any],
    name: str,
    params: Any,
    warn: Callable[[str], None],
) -> None:
    """Judge new parameters of a node as strictly as the controller's ``tuning.guard`` says.

    Raises
    ------
    ParameterError
        They are refused.
    """
    if name not in ("observer", "controller", "reference"):
        return
    law = params if name == "controller" else running["controller"]
    if law.tuning.guard == "off":
        return
    if name == "reference":
        after = altered(experiment, {**running, name: params})
        starts = params == running[name]  # else it turns into another while the loop runs
        reason = unheld(after, None if starts else altered(experiment, running)) or None
        instead = "a shaper"
    else:
        reason, instead = judge(experiment, {name: params}, running), "other gains"
    if reason is None:
        return
    if law.tuning.guard == "warn":
        warn(f"{name}: {reason}")
        return
    raise ParameterError(
        f"{reason}: give {instead}, or set tuning.guard of the controller to warn or off"
    )


def experiment_of(values: Mapping[str, Mapping[str, Any]]) -> Experiment:
    """What nodes with such values run, without a name.

    Parameters
    ----------
    values : mapping of str to mapping
        Values of each node, as the parameter services tell them.
    """
    nodes = {}
    for name, schema in SCHEMAS.items():
        left = ("preset", "axes")
        own = {n: v for n, v in values[name].items() if v is not None and n not in left}
        served = node_specs(schema, own)
        nodes[name] = resolve(name, schema, [{n: v for n, v in own.items() if n in served}])
    return Experiment("", ExperimentParams(), nodes)


def of_nodes(
    values: Mapping[str, Mapping[str, object]],
    role: str,
    params: object,
    warn: Callable[[str], None],
) -> None:
    """Judge new parameters of a running node by what it knows of its neighbours.

    A reference that has them already is judged as it begins.

    Parameters
    ----------
    values : mapping of str to mapping
        Values of plant, observer and controller, as their parameter services tell them, and of the
        node itself.
    role : str
        The node: observer, controller or reference.
    params : dataclass
        Its new parameters.
    warn : callable
        Told what is not refused.

    Raises
    ------
    ParameterError
        They are refused.
    """
    told: Any = values[role].get("axes", (AXIS,))
    axes = tuple(told)
    for axis, own_params in zip(axes, per_axis(params), strict=True):
        own = {name: own_of(axes, axis, each) for name, each in values.items()}
        experiment = experiment_of({"reference": {"T_s": own[role]["T_s"]}, **own})
        running = {name: node.params for name, node in experiment.nodes.items()}
        if own_params == running[role] and role != "reference":
            continue
        try:
            guard(experiment, running, role, own_params, warn)
        except ParameterError as error:
            raise ParameterError(f"{axis}: {error}" if len(axes) > 1 else str(error)) from None
