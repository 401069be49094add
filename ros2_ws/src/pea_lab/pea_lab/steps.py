"""How far the voltage steps when one parameter is changed in steady tracking.

The same run is made twice, once with the change and once without. The step is by how much the
first voltage that goes by the change differs from that of the run without it: what the voltage
does anyway, following its reference, is in both.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from pea_controller import model as controllers
from pea_core.block import changed
from pea_core.injection import InjectParams
from pea_core.live import WARM
from pea_core.loop import blocks_of, trace
from pea_core.params import ParameterError, Spec, specs
from pea_experiment import experiments
from pea_experiment.experiment import SCHEMAS, Experiment
from pea_lab.guard import judge
from pea_observer import model as observers

BEFORE = 600
"""Samples until the change: 30 ms, longer than any of these loops takes to settle."""

AFTER = 20
"""Samples after it in which the voltage is looked at."""

LARGEST = 1e-6
"""Step (V) that no change of a parameter may cause, and no change of type."""

ROUNDING = 1e-12
"""Step (V) that is none: the difference of two voltages of up to some 100 V is rounded by less."""

WITHOUT_EFFECT = {
    *("tuning.guard", "tuning.gain_margin", "tuning.delay_margin"),
    *("tuning.modulus_margin", "tuning.phase_margin"),
    *(
        f"inject.{field.name}"
        for field in dataclasses.fields(InjectParams)
        if field.name != "where"
    ),
}
"""Parameters that no voltage depends on; those of a test signal where none is injected."""


class Step(NamedTuple):
    """What one change did.

    Attributes
    ----------
    node, kind, name : str
        Which parameter, of which type.
    old, new : value
        Before and after.
    step : float
        Difference of the first voltage (V).
    later : float
        Largest change of that difference from sample to sample after it (V).
    """

    node: str
    kind: str
    name: str
    old: Any
    new: Any
    step: float
    later: float


def kinds() -> Iterator[tuple[str, str]]:
    """Every type of observer and controller."""
    for node, models in (("observer", observers.MODELS), ("controller", controllers.MODELS)):
        for kind in models:
            yield node, kind


def tracking(controller: str, observer: str) -> Experiment:
    """A sine of 150 Hz over hysteresis, creep, noise and a delay.

    Parameters
    ----------
    controller, observer : str
        Presets or types.
    """
    sets = ["plant.preset=hysteresis_creep_noise_delay", "plant.sensor.ideal=true"]
    others = {"controller": controller, "observer": observer}
    return experiments.load("fig10_sine_150hz", sets, 1.0, None, others)


@cache
def typical(node: str, kind: str) -> Experiment:
    """A tracking loop with a node of one type, tuned as its preset is."""
    if node == "controller":
        law = getattr(controllers.MODELS[kind].Params, "PRESET", kind)
        return tracking(law, "extended_state")
    return tracking("recommended", kind)


def needed(node: str, name: str, value: Any) -> dict[str, Any]:
    """A change, with what a law needs to be given with its type."""
    laws = controllers.MODELS if (node, name) == ("controller", "type") else {}
    return {name: value, **getattr(laws.get(value), "NEEDS", {})}


def switching(node: str, params: object) -> float:
    """Steps (V) that the command of a law makes anyway in steady state."""
    if node != "controller":
        return 0.0
    model = controllers.MODELS[controllers.CHOICE.type_of(params)]
    return float(model.switching(params)) if hasattr(model, "switching") else 0.0


def changes(node: str, kind: str) -> dict[str, list[Any]]:
    """New values for every parameter that may change while the loop runs: half and twice."""
    values = typical(node, kind).nodes[node].values
    found: dict[str, list[Any]] = {}
    for name, spec in specs(SCHEMAS[node], {"type": kind}).items():
        value = values[name]
        if spec.fixed or name in WITHOUT_EFFECT:
            continue
        if spec.choices:
            found[name] = [other for other in spec.choices if other != value]
        elif isinstance(value, bool):
            found[name] = [not value]
        elif isinstance(value, tuple | list):
            each = [half_and_twice(float(x), spec) for x in value or (0.0,)]
            found[name] = [tuple(row[i] for row in each) for i in range(min(map(len, each)))]
        else:
            assert isinstance(value, int | float)
            found[name] = half_and_twice(value, spec)
    return found


def half_and_twice(value: float, spec: Spec) -> list[float]:
    """Half and twice a value, as far as that is allowed; a hundredth of the most for 0."""
    assert spec.low is not None
    assert spec.high is not None
    wanted = [0.5 * value, 2.0 * value] if value else [0.01 * spec.high]
    return [min(max(other, spec.low), spec.high) for other in wanted]


def measure(node: str, kind: str) -> Iterator[Step]:
    """Make every change of one type's parameters, and to every other type.

    What a law refuses is left out.
    """
    experiment = typical(node, kind)
    values = experiment.nodes[node].values
    n = BEFORE + math.ceil(WARM / experiment.T_s) + AFTER
    still = _voltages(experiment, node, None, n)
    for name, others in changes(node, kind).items():
        for other in others:
            new = needed(node, name, other)
            k = BEFORE + (math.ceil(WARM / experiment.T_s) if name == "type" else 0)
            try:
                u = _voltages(experiment, node, new, k + AFTER)
            except ParameterError:
                continue
            apart = u[: k + AFTER] - still[: k + AFTER]
            later = float(np.abs(np.diff(apart[k:])).max())
            yield Step(node, kind, name, values[name], other, float(abs(apart[k])), later)


def bound(step: Step) -> float:
    """Largest step (V) that a change may cause."""
    old = typical(step.node, step.kind).nodes[step.node].params
    new = changed(SCHEMAS[step.node], old, needed(step.node, step.name, step.new))
    largest = max(LARGEST, switching(step.node, old), switching(step.node, new))
    return largest + ROUNDING


def _voltages(
    experiment: Experiment, node: str, values: dict[str, Any] | None, samples: int
) -> np.ndarray:
    """Commands of a run, with a change after `BEFORE`."""
    loop = experiment.loop()
    rows = [loop.run(BEFORE)]
    if values is not None:
        block = getattr(loop, node)
        block.retune(changed(SCHEMAS[node], block.planned, values))
    rows += [loop.run(n) for n in blocks_of(samples - BEFORE)]
    return np.asarray(trace(rows)["u"])


def refused(step: Step) -> bool:
    """Whether the guard would not have taken the change."""
    experiment = typical(step.node, step.kind)
    running = {node: experiment.nodes[node].params for node in experiment.nodes}
    new = needed(step.node, step.name, step.new)
    params = changed(SCHEMAS[step.node], running[step.node], new)
    return judge(experiment, {step.node: params}, running) is not None


def table() -> Iterator[tuple[str, ...]]:
    """For every type, the change of a value, and that of the type, with the largest step."""
    for node, kind in kinds():
        found = list(measure(node, kind))
        for group in (
            [step for step in found if step.name != "type"],
            [step for step in found if step.name == "type"],
        ):
            taken = [step for step in group if not refused(step)]
            if taken:
                worst = max(group, key=lambda step: step.step)
                after = max(taken, key=lambda step: step.later)
                yield (
                    f"{node} `{kind}`",
                    str(len(group)),
                    str(len(group) - len(taken)),
                    f"`{worst.name}` {_text(worst.old)} to {_text(worst.new)}",
                    f"{worst.step:.2g}",
                    f"{after.later:.2g}",
                    f"`{after.name}` to {_text(after.new)}",
                )


def _text(value: object) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)
