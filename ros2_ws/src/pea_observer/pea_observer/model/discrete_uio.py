r"""Unknown-input observer of the sampled plant.

Displacement feedback misses the matching condition in continuous time, C B = 0, but the sampled
plant meets it, C Gamma != 0. So the unknown input of the interval that ends at t_k follows from
y_k alone, whatever it was before:

.. math:: \bar x_k = \Phi \hat x_{k-1} + \Gamma u_{k-1}, \quad
          \hat\varepsilon_k = (C \Gamma)^{-1} (y_k - C \bar x_k), \quad
          \hat x_k = \bar x_k + \Gamma \hat\varepsilon_k

It is unbiased for any eps, and there is nothing to tune: the error's poles are 0 and the sampling
zero of the plant (-0.8615 at 20 kHz), so it rings at the Nyquist frequency, and 0.7 nm of noise
make 0.154 V in one step.

Inputs
    `Measurement` (m, V).
Outputs
    `Estimate` (m, m/s, V).
State
    the last estimate.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

from pea_core.nominal import NominalModel, hold, state_space
from pea_core.params import ParameterError
from pea_core.signals import Estimate, Measurement
from pea_observer.model.current_form import refuse_unstable


@dataclass(frozen=True)
class Params(NominalModel):
    """Nominal model; the observer follows from it."""

    PRESET: ClassVar[str] = "discrete_uio"


class Coefficients(NamedTuple):
    """Phi (2, 2) and Gamma (2), entry by entry."""

    f11: float
    f12: float
    f21: float
    f22: float
    g1: float
    g2: float


class State(NamedTuple):
    """Displacement (m) and velocity (m/s) after the last correction."""

    x1: float
    x2: float


def design(params: Params, T_s: float) -> Coefficients:
    """Discretise Eq 2.

    Raises
    ------
    ParameterError
        The sampling zero is not inside the unit circle, or y does not tell eps in one sample.
    """
    A, B, C = state_space(params)
    F, G = hold(A, B, T_s)
    if not abs(G[0, 0]) > 0.0:
        raise ParameterError(
            "the observer cannot be designed: y does not determine eps in one sample"
        )
    refuse_unstable(F, C @ F, G[:, 0] / G[0, 0])
    return Coefficients(*F.ravel().tolist(), *G[:, 0].tolist())


def start(c: Coefficients) -> State:
    """At rest."""
    return State(0.0, 0.0)


def output(c: Coefficients, s: State, measured: Measurement) -> Estimate:
    """The eps that explains y."""
    u = measured.u_applied
    x1 = c.f11 * s.x1 + c.f12 * s.x2 + c.g1 * u
    x2 = c.f21 * s.x1 + c.f22 * s.x2 + c.g2 * u
    eps = (measured.y - x1) / c.g1
    return Estimate(x1 + c.g1 * eps, x2 + c.g2 * eps, eps)


def update(c: Coefficients, s: State, measured: Measurement, estimate: Estimate) -> State:
    """Keep the estimate."""
    return State(estimate.x1, estimate.x2)
