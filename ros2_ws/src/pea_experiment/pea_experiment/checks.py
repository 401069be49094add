"""What must hold among the parameters of an experiment, and what warns after a run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pea_core.block import Signal
from pea_core.params import ParameterError
from pea_experiment.experiment import (
    AnyExperiment,
    Experiment,
)
from pea_observer import model as observer
from pea_plant import drivers, specimen
from pea_plant.model.actuator import steady_state_gain
from pea_plant.plant import Params as PlantParams
from pea_reference import model as reference

LOOKS = 10_000
"""Samples at which a long reference is compared with the stroke."""


def of_one_scan(each: Sequence[Experiment]) -> None:
    """Refuse axes of one scan that do not follow the same one.

    Raises
    ------
    ParameterError
        A parameter of the scan differs between two axes, or two have the same part of it.
    """
    scans: dict[str, dict[str, tuple[str, dict[str, Any]]]] = {}
    for one in each:
        params = one.nodes["reference"].params
        kind = reference.CHOICE.type_of(params)
        if (scan := getattr(reference.MODELS[kind], "scan", None)) is None:
            continue
        parts, own = scans.setdefault(kind, {}), scan(params)
        for axis, shared in parts.values():
            for name, value in own.items():
                if value != shared[name]:
                    raise ParameterError(
                        f"reference.{one.axis}.{name} = {_told(value)}: differs from "
                        f"reference.{axis}.{name} = {_told(shared[name])}; a {kind} has one for "
                        f"all its axes: give reference.{name}"
                    )
        if params.part in parts:
            raise ParameterError(
                f"reference.{one.axis}.part = {params.part!r}: the axis {parts[params.part][0]} "
                f"has this part of the {kind} already; give it another"
            )
        parts[params.part] = one.axis, own


def _told(value: object) -> str:
    return f"{value:g}" if isinstance(value, float) else repr(value)


def refuse_driver(experiment: AnyExperiment) -> None:
    """Refuse a device whose driver cannot be made, before a node starts; nothing is opened.

    Raises
    ------
    ParameterError
        A parameter of the driver is wrong, or a Python package that it needs is missing.
    """
    drivers.check(tuple(one.nodes["plant"].params for one in experiment.each), experiment.T_s)


def refuse_specimen(experiment: AnyExperiment) -> None:
    """Refuse a specimen that is none, before anything runs.

    A recording names its specimen, too, and is read without it.

    Raises
    ------
    ParameterError
        It is no formula, and no picture that can be read.
    """
    specimen.of([one.nodes["plant"].params for one in experiment.each])


def admit(experiment: Experiment) -> None:
    """Refuse an observer that needs what the sensor does not tell.

    Raises
    ------
    ParameterError
        It needs the true velocity.
    """
    nodes = experiment.nodes
    plant = nodes["plant"].params
    type_ = observer.CHOICE.type_of(nodes["observer"].params)
    if getattr(observer.MODELS[type_], "NEEDS_VELOCITY", False) and not plant.sensor.ideal:
        raise ParameterError(
            f"observer.type = {type_!r}: needs the true velocity; add "
            "--set plant.sensor.ideal=true, or choose another observer"
        )


def within_stroke(signal: Signal, samples: int, plant: PlantParams, beyond: float = 0.0) -> None:
    """Refuse a reference that the actuator cannot reach with its voltages.

    `beyond` (m) is what else is added to it, either sign.

    Long references are looked at `LOOKS` times, at samples drawn at random once and for all.

    Raises
    ------
    ParameterError
        It leaves voltage_min K to voltage_max K.
    """
    looks: Sequence[int] = range(samples)
    if samples > LOOKS:
        looks = np.random.default_rng(0).integers(0, samples, LOOKS).tolist()
    w = [signal.at(k).w for k in looks]
    within_reach(min(w) - beyond, max(w) + beyond, plant, steady_state_gain(plant))


def within_reach(least: float, most: float, plant: PlantParams, K: float) -> None:
    """Refuse displacements (m) that a plant of gain K (um/V) cannot reach with its voltages.

    Raises
    ------
    ParameterError
        They leave voltage_min K to voltage_max K.
    """
    least, most = least * 1e6, most * 1e6
    low, high = plant.voltage_min * K, plant.voltage_max * K
    slack = 1e-9 * (high - low)
    if not (least >= low - slack and most <= high + slack):  # nor a number that is none
        raise ParameterError(
            f"reference from {least:.4g} to {most:.4g} um: outside the stroke of {low:.4g} to "
            f"{high:.4g} um, which is {plant.voltage_min:g} to {plant.voltage_max:g} V times "
            f"{K:.4g} um/V; give it less amplitude or another offset"
        )


def too_small(experiment: Experiment, figures: Mapping[str, object]) -> str | None:
    """Warning where a switching gain eta is below the eps that a run has met (Eq 13), or None.

    Parameters
    ----------
    experiment : Experiment
    figures : mapping
        The run's metrics.
    """
    params = experiment.nodes["controller"].params
    eta = getattr(params, "eta", None)
    what = "eps_left_max_V" if params.eps_compensation else "eps_max_V"
    bound = figures[what]
    if eta is None or bound is None or eta >= bound:
        return None
    name = "eps - eps_hat" if params.eps_compensation else "eps"
    return (
        f"controller.eta = {eta:g} V: below |{name}| of up to {bound:.3g} V in this run, so the "
        "sliding surface is left; give eta above that bound"
    )
