r"""Decoupling of a stage: how a command of an axis is shared out among the actuators.

With the stage's response G(z), n axes and n actuators, and its gain K = G(1):

- static, the matrix with which each axis moves alone at rest, as far as its own actuator moves it,

.. math:: A_0 = K^{-1}\,\mathrm{diag}(K);

- by the dynamics, a filter of N taps with the same gain that makes G A diagonal up to a frequency,

.. math:: \min_A \sum_{\omega \le \omega_1} \frac{\omega_1^2}{\omega^2}
          \left\| D^{-1} (G A - \mathrm{diag}(G A_0)) \right\|_F^2
          + \rho^2 \sum_{\omega} \left\| A - A_0 \right\|_F^2 , \quad D = \mathrm{diag}(K),

linear least squares in the taps. rho keeps the filter near its gain beyond omega_1; it grows until
the filter has an inverse that is stable, by which each axis is told what it got.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from pea_core.matrix_filter import SLOWEST, slowest
from pea_core.params import ParameterError
from pea_experiment.experiment import MultiAxis
from pea_lab.coupled import TOLD, plant
from pea_lab.guard import altered
from pea_lab.linear import System, at, balanced

POINTS = 600
"""Frequencies of a fit; twice as many near the edge of the band as far from it."""

RHO_MIN, RHO_MAX = 1e-3, 10.0
"""Weights of the filter's distance from its gain that are tried."""

NEAR_REST = 0.03
"""Share of the band below which all frequencies count alike; above it the less, the higher."""

AT_REST = 1e3
"""Weight of the gain."""


class Decoupling(NamedTuple):
    """What was found.

    Attributes
    ----------
    taps : (N, n, n) array
        From axes to actuators.
    f : (m,) array
        Frequencies (Hz) up to the edge of the band.
    before, static, after : (m,) array
        Largest share of a command that another axis sees, in what its own axis sees at rest:
        without a matrix, with the static one, with the taps.
    """

    taps: np.ndarray
    f: np.ndarray
    before: np.ndarray
    static: np.ndarray
    after: np.ndarray


def response(stage: System, z: np.ndarray) -> np.ndarray:
    """From the commands to the measured displacements (m/V) of the axes: (m, n, n) array."""
    stage = balanced(stage)
    axes = [i for i in range(len(stage.C)) if i % TOLD == 0]
    return (at(stage, z) + stage.D)[:, axes]


def first_mode(experiment: MultiAxis) -> float:
    """The lowest natural frequency (Hz) of the actuators."""
    found = []
    for one in experiment.each:
        params = one.nodes["plant"].params
        found.append(np.min(getattr(params.vibration, "omega_n", params.omega_n)))
    return float(min(found)) / (2.0 * math.pi)


def bare(experiment: MultiAxis) -> MultiAxis:
    """The experiment without a matrix from axes to actuators."""
    each = []
    for one in experiment.each:
        params = one.nodes["plant"].params
        stage = replace(params.stage, axes_to_actuators=())
        each.append(altered(one, {"plant": replace(params, stage=stage)}))
    return MultiAxis(tuple(each))


def decouple(experiment: MultiAxis, taps: int, edge: float) -> Decoupling:
    """Find a filter from axes to actuators, or for one tap a matrix.

    Parameters
    ----------
    experiment : MultiAxis
        Whose nominal stage is decoupled; a matrix that it has already is left out.
    taps : int
        N, from 1 on.
    edge : float
        Up to which frequency (Hz), from 0 to half the sampling rate; of one tap of no concern.

    Raises
    ------
    ParameterError
        The gain of the stage is singular, the edge is out of range, or no filter has a stable
        inverse.
    """
    T_s = experiment.T_s
    if not 0.0 < edge < 0.5 / T_s:
        raise ParameterError(f"--to {edge:g} Hz: must be above 0 and below {0.5 / T_s:g} Hz")
    stage = plant(bare(experiment))
    K = response(stage, np.array([1.0 + 0.0j]))[0].real
    if not np.linalg.cond(K) < 1e8:
        raise ParameterError(
            f"the gain of the stage, {np.round(K * 1e6, 6).tolist()} um/V, is singular: an axis "
            "cannot be moved alone; choose other axes (plant.stage.sensors_to_axes)"
        )
    own = np.diag(K)
    if np.any(np.abs(own) < 1e-6 * np.abs(K).max()):
        raise ParameterError(
            f"the gain of the stage, {np.round(K * 1e6, 6).tolist()} um/V, has a 0 on its "
            "diagonal: an axis is not moved by its own actuator; exchange the axes"
        )
    A_0 = np.linalg.solve(K, np.diag(own))
    below = np.linspace(edge / POINTS, edge, 2 * POINTS // 3)
    weight = edge / np.maximum(below, NEAR_REST * edge)
    f = np.concatenate([below, np.linspace(edge, 0.5 / T_s, POINTS // 3)[1:]])
    G = response(stage, np.exp(2j * math.pi * f * T_s))
    found, rho = A_0[np.newaxis], RHO_MIN
    while taps > 1:
        found = _fit(G, f * T_s, weight, A_0, own, taps, rho)
        if slowest(found) < SLOWEST:
            break
        if (rho := rho * math.sqrt(10.0)) > RHO_MAX:
            raise ParameterError(
                f"--taps {taps} --to {edge:g}: no such filter has a stable inverse; give a lower "
                "--to, or another number of --taps"
            )
    band = f <= edge
    delays = np.exp(-2j * math.pi * f[band, None] * T_s * np.arange(len(found)))
    ways = (np.eye(len(K)), A_0, np.einsum("fm,mij->fij", delays, found))
    return Decoupling(found, f[band], *(_crossed(G[band] @ way, own) for way in ways))


def _crossed(response: np.ndarray, own: np.ndarray) -> np.ndarray:
    """Largest share of a command that another axis sees, at each frequency."""
    share = np.abs(response) / np.abs(own)[:, None]
    share[:, np.arange(len(own)), np.arange(len(own))] = 0.0
    found: np.ndarray = share.max(axis=(1, 2))
    return found


def _fit(
    G: np.ndarray,
    angle: np.ndarray,
    weight: np.ndarray,
    A_0: np.ndarray,
    own: np.ndarray,
    taps: int,
    rho: float,
) -> np.ndarray:
    """Taps (N, n, n) by least squares; `angle` in turns a sample, `weight` of those in the band."""
    n, band = len(A_0), slice(len(weight))
    E = np.exp(-2j * math.pi * angle[:, None] * np.arange(taps))
    near = np.kron(np.eye(n), E).reshape(n * len(angle), n * taps)
    still = AT_REST * np.kron(np.eye(n), np.ones(taps))
    scale = weight[:, None, None] / own[:, None]
    seen = ((G[band] * scale)[:, :, :, None] * E[band][:, None, None, :]).reshape(-1, n * taps)
    wanted = (G[band] @ A_0) * scale
    found = np.zeros((taps, n, n))
    for j in range(n):
        asked = np.zeros(wanted.shape[:2], complex)
        asked[:, j] = wanted[:, j, j]
        M = np.vstack([seen, rho * near, still])
        b = np.concatenate(
            [asked.ravel(), rho * np.repeat(A_0[:, j], len(angle)), AT_REST * A_0[:, j]]
        )
        x = np.linalg.lstsq(np.vstack([M.real, M.imag]), np.concatenate([b.real, b.imag]))[0]
        found[:, :, j] = x.reshape(n, taps).T
    return found
