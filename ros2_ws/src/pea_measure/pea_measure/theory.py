"""What theory says of a running loop at the lines of a measurement.

Twice: on the nominal plant, as ``pea check`` does; and on the simulated plant as it is, with its
creep and with the slope that its hysteresis has for signals as small as those measured.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from pea_experiment.experiments import Experiment
from pea_lab import linear
from pea_lab.check import response
from pea_plant.model import hysteresis

TURNS, STEPS = 3, 60
"""Small loops of the voltage, and steps of each, from which the slope of H is taken."""


def slope_of_hysteresis(experiment: Experiment, u: float, amplitude: float) -> float:
    """Slope of H for small signals about u.

    Parameters
    ----------
    experiment : Experiment
    u : float
        Operating point (V), reached from rest.
    amplitude : float
        Largest deviation from it (V).
    """
    params = experiment.nodes["plant"].params.hysteresis
    model = hysteresis.MODELS[hysteresis.CHOICE.type_of(params)]
    c = model.design(params, experiment.T_s)
    s = model.start(c)
    small = amplitude * np.sin(2.0 * math.pi * np.arange(TURNS * STEPS) / STEPS)
    way = np.concatenate([np.linspace(0.0, u, 400), u + small])
    v = []
    for each in way.tolist():
        s = model.update(c, s, each)
        v.append(model.output(c, s))
    last = slice(len(way) - STEPS, None)
    return float(np.polyfit(way[last], np.array(v)[last], 1)[0])


def with_creep(experiment: Experiment) -> linear.Blocks:
    """The blocks of the loop, the plant with its creep."""
    parts = linear.blocks(experiment)
    return parts._replace(plant=linear.plant(experiment, creeps=True))


def sensitivity(parts: linear.Blocks, f: np.ndarray, T_s: float, gain: float = 1.0) -> np.ndarray:
    """S (F,) at frequencies f (Hz), the gain of the actuator times `gain`."""
    L = -response(linear.assemble(parts, gain), 2.0 * math.pi * f * T_s)
    return np.asarray(1.0 / (1.0 + L))


def nominal(experiment: Experiment, f: np.ndarray) -> np.ndarray:
    """S (F,) on the nominal plant.

    Raises
    ------
    Nonlinear
        The observer or the law is not linear.
    """
    return sensitivity(linear.blocks(experiment), f, experiment.T_s)


def of_plant(experiment: Experiment, f: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, float]:
    """S (F,) on the simulated plant about the voltages u (V) of a run, and the slope of its H."""
    middle = 0.5 * float(u.max() + u.min())
    gain = slope_of_hysteresis(experiment, middle, 0.5 * float(np.ptp(u)))
    return sensitivity(with_creep(experiment), f, experiment.T_s, gain), gain


def following(experiment: Experiment, f: np.ndarray) -> np.ndarray | None:
    """T_w (F,), from a test signal at the reference to y, on the nominal plant.

    None where the law is not linear in the reference.
    """
    tick, start = linear.controller_tick(experiment)
    if not linear.superposes(tick, start, linear.ESTIMATE + linear.REFERENCE + linear.REFERENCE):
        return None
    law = linear.balanced(linear.minimal(linear.linearise(tick, start, 9)))
    omega = 2.0 * math.pi * f
    z, preview = np.exp(1j * omega * experiment.T_s), experiment.nodes["controller"].params.preview
    parts = linear.blocks(experiment)
    w = np.stack([np.ones(len(f)), 1j * omega, -(omega**2)], axis=1)
    ahead = w * np.exp(1j * omega * preview * experiment.T_s)[:, None]
    ones = np.eye(len(law.A))
    K = law.C @ np.linalg.solve(z[:, None, None] * ones - law.A, law.B.astype(complex)) + law.D
    from_w = np.einsum("fi,fi->f", K[:, 0, 3:], np.concatenate([w, ahead], axis=1))
    plant = linear.balanced(parts.plant)
    ones = np.eye(len(plant.A))
    P = plant.C @ np.linalg.solve(z[:, None, None] * ones - plant.A, plant.B.astype(complex))
    S = sensitivity(parts, f, experiment.T_s)
    return np.asarray(P[:, 0, 0] * S * from_w)


def changed(experiment: Experiment, **inject: object) -> Experiment:
    """The experiment with another test signal."""
    node = experiment.nodes["controller"]
    params = dataclasses.replace(
        node.params, inject=dataclasses.replace(node.params.inject, **inject)
    )
    return dataclasses.replace(
        experiment, nodes={**experiment.nodes, "controller": node._replace(params=params)}
    )
