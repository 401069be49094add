"""Gains that theory finds unstable, or too near to it, are refused before they are taken.

The gain margin of a loop is by how much its gain at u may rise or fall until it is unstable,
whichever is less: 1.3 for one that bears 30 % either way, below 1 for one that is unstable and
would be stable with so much of its gain. The delay margin is how many samples later u may come.
Both are those of ``pea check``, on the nominal plant.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from pea_core.config import NodeParams, Resolved, node_specs, resolve
from pea_core.params import ParameterError, flatten
from pea_runtime.check import GAINS, ROUNDING, delay_margin, radius
from pea_runtime.experiments import SCHEMAS, Experiment, ExperimentParams
from pea_runtime.linear import Loop, Nonlinear, assemble, blocks

STEP = 0.01
"""Steps of the gain, as a share of it, in which a margin is looked for; it is told so exactly."""

WORSE = 1e-6
"""By how much a margin must fall to be worse."""

UNITS = ("", " samples")
"""Of each of `Margins`, behind the number."""


class Margins(NamedTuple):
    """How far a loop is from instability.

    Attributes
    ----------
    gain : float
        By how much its gain may rise or fall; 0 where no gain makes it stable.
    delay : float
        How many samples later u may come; 0 for an unstable loop, infinite where none does harm.
    """

    gain: float
    delay: float


BOUNDLESS = Margins(math.inf, math.inf)
"""Of a loop that has no margins."""


def margin(loop: Loop, enough: float) -> float:
    """Gain margin of a loop, looked for up to `enough`."""

    def stable(gain: float) -> bool:
        return radius(loop.closed(gain)) < 1.0 + ROUNDING

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
    """Margins of a loop, that of the gain looked for up to `enough`; `BOUNDLESS` if nonlinear."""
    try:
        loop = assemble(blocks(experiment))
    except Nonlinear:
        return BOUNDLESS
    gain = margin(loop, enough)
    delay = delay_margin(loop) if gain >= 1.0 else 0.0
    return Margins(gain, math.inf if delay is None else delay)


def altered(experiment: Experiment, changes: Mapping[str, Any]) -> Experiment:
    """The experiment with other parameters of some of its nodes."""
    nodes = dict(experiment.nodes)
    for name, params in changes.items():
        node = nodes[name].node
        values = {**flatten(NodeParams, node), **flatten(SCHEMAS[name], params)}
        nodes[name] = Resolved(node, params, values)
    return dataclasses.replace(experiment, nodes=nodes)


def judge(
    experiment: Experiment, changes: Mapping[str, Any], running: Mapping[str, Any] | None = None
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
        For example ``gain margin 0.8 < 1.3 at T_s 50 us``. None for a law or an observer that is
        not linear: it has no margins.
    """
    before = altered(experiment, running or {})
    after = altered(before, changes)
    tuning = after.nodes["controller"].params.tuning
    least = Margins(tuning.gain_margin, tuning.delay_margin)
    found = margins(after, least.gain)
    if found.gain >= least.gain and found.delay >= least.delay:
        return None
    had = margins(before, least.gain) if running is not None else BOUNDLESS
    for name, unit, now, then, enough in zip(Margins._fields, UNITS, found, had, least):
        if now < min(enough, then - WORSE):
            told = f"{math.floor(now * 100.0) / 100.0:g} < {enough:g}{unit}"
            return f"{name} margin {told} at T_s {experiment.T_s * 1e6:g} us"
    return None


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
    if name not in ("observer", "controller"):
        return
    law = params if name == "controller" else running["controller"]
    if law.tuning.guard == "off":
        return
    reason = judge(experiment, {name: params}, running)
    if reason is None:
        return
    if law.tuning.guard == "warn":
        warn(f"{name}: {reason}")
        return
    raise ParameterError(
        f"{reason}: give other gains, or set tuning.guard of the controller to warn or off"
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
        own = {n: v for n, v in values[name].items() if v is not None and n != "preset"}
        served = node_specs(schema, own)
        nodes[name] = resolve(name, schema, [{n: v for n, v in own.items() if n in served}])
    return Experiment("", ExperimentParams(), nodes)


def of_nodes(
    values: Mapping[str, Mapping[str, Any]],
    role: str,
    params: Any,
    warn: Callable[[str], None],
) -> None:
    """Judge new parameters of a running node by what it knows of its neighbours.

    Parameters
    ----------
    values : mapping of str to mapping
        Values of plant, observer and controller, as their parameter services tell them.
    role : str
        The node.
    params : dataclass
        Its new parameters.
    warn : callable
        Told what is not refused.

    Raises
    ------
    ParameterError
        They are refused.
    """
    experiment = experiment_of({**values, "reference": {"T_s": values[role]["T_s"]}})
    nodes = experiment.nodes
    guard(experiment, {name: node.params for name, node in nodes.items()}, role, params, warn)
