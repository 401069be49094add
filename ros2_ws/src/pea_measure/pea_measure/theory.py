"""What theory says of a running loop at the lines of a measurement.

Twice: on the nominal plant, as ``pea check`` does; and on the simulated plant as it is, with its
creep and with the gain and phase that its hysteresis has along the voltages of the run.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from pea_core.injection import Plan
from pea_experiment.experiment import Experiment
from pea_lab import linear
from pea_plant.model import hysteresis


def gain_of_hysteresis(
    experiment: Experiment, plan: Plan, u: np.ndarray, start: int
) -> tuple[float, complex]:
    """Gain of H for the voltages u (N,) in V of a run, from rest: for its size, and with its phase.

    The complex gain is that of the linear system that is closest to H at the lines of the test
    signal: where a loop has a width, its output lags.
    """
    params = experiment.nodes["plant"].params.hysteresis
    model = hysteresis.MODELS[hysteresis.CHOICE.type_of(params)]
    c = model.design(params, experiment.T_s)
    s = model.start(c)
    v = np.empty(len(u))
    for k, each in enumerate(u.tolist()):
        s = model.update(c, s, each)
        v[k] = model.output(c, s)
    U, V = (np.fft.rfft(plan.measured(x, start).mean(axis=3)[:, 0], axis=0) for x in (u, v))
    over, under = 0j, 0.0
    for block, lines in enumerate(plan.lines):
        over += complex(V[lines, block] @ U[lines, block].conj())
        under += float(np.sum(np.abs(U[lines, block]) ** 2))
    gain = over / under if under > 0.0 else 1.0 + 0j
    return abs(gain), gain


def with_creep(experiment: Experiment) -> linear.LinearBlocks:
    """The blocks of the loop, the plant with its creep."""
    parts = linear.blocks(experiment)
    return parts._replace(plant=linear.plant(experiment, creeps=True))


def at(system: linear.System, z: np.ndarray) -> np.ndarray:
    """Response (F, m, n) of a system at z (F,)."""
    A, B, C, D = linear.balanced(system)
    return np.asarray(C @ np.linalg.solve(z[:, None, None] * np.eye(len(A)) - A, B + 0j) + D)


def sensitivity(
    parts: linear.LinearBlocks,
    f: np.ndarray,
    T_s: float,
    gain: complex = 1.0,
    measured: np.ndarray | None = None,
) -> np.ndarray:
    """S (F,) at frequencies f (Hz).

    Parameters
    ----------
    parts : Blocks
    f : (F,) array
    T_s : float
        Sample period (s).
    gain : complex
        Of the actuator, relative to its own.
    measured : (F,) array, optional
        Response of the stage (m/V) in place of that of the blocks.
    """
    return np.asarray(1.0 / (1.0 - np.einsum("fi,fi->f", *around(parts, f, T_s, gain, measured))))


def around(
    parts: linear.LinearBlocks,
    f: np.ndarray,
    T_s: float,
    gain: complex = 1.0,
    measured: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """The law (F, 3), and the estimates (F, 3) of a command of 1 V: their product is -L."""
    z = np.exp(2j * math.pi * f * T_s)
    plant, observer, law = (at(part, z) for part in parts[:3])
    told = plant[:, :3, 0] * np.array([gain, gain, 1.0])
    if measured is not None:
        told[:, 0] = measured
    return law[:, 0, :3], np.einsum("fij,fj->fi", observer[:, :, :3], told)


def nominal(experiment: Experiment, f: np.ndarray) -> np.ndarray:
    """S (F,) on the nominal plant.

    Raises
    ------
    Nonlinear
        The observer or the law is not linear.
    """
    return sensitivity(linear.blocks(experiment), f, experiment.T_s)


def of_plant(
    experiment: Experiment, f: np.ndarray, plan: Plan, u: np.ndarray, start: int
) -> tuple[np.ndarray, float]:
    """S (F,) on the simulated plant along the voltages u (V) of a run, and the slope of its H."""
    slope, gain = gain_of_hysteresis(experiment, plan, u, start)
    return sensitivity(with_creep(experiment), f, experiment.T_s, gain), slope


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
    from_w = np.einsum("fi,fi->f", at(law, z)[:, 0, 3:], np.concatenate([w, ahead], axis=1))
    S = sensitivity(parts, f, experiment.T_s)
    return np.asarray(at(parts.plant, z)[:, 0, 0] * S * from_w)


def changed(experiment: Experiment, **inject: object) -> Experiment:
    """The experiment with another test signal."""
    node = experiment.nodes["controller"]
    params = dataclasses.replace(
        node.params, inject=dataclasses.replace(node.params.inject, **inject)
    )
    return dataclasses.replace(
        experiment, nodes={**experiment.nodes, "controller": node._replace(params=params)}
    )
