r"""State feedback over the delay on a model of several modes, docs/resonant.md.

.. math:: u = v + h(v) - g\,\tilde\delta - \tilde\varepsilon

v is the voltage that the model needs along the reference, h what the hysteresis takes from it,
delta~ and eps~ the deviation and the unknown input at the instant at which u begins to act
(`modal`). g minimises the sum of

.. math:: y^2 + \rho\,(K u)^2

over all samples: LQR. Since delta~ is predicted, it is the optimal gain with the delay. Integral
action is in eps. A large effort rho moves hardly a pole: what is left then is the feedforward and
the unknown input, and the modes keep their own damping.

Inputs
    `Reference` W (m, m/s, m/s^2), the same previewed, `Estimate` (m, m/s, V), x1 as measured.
Outputs
    command u (V).
State
    see `modal`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from pea_controller.model import modal
from pea_controller.model.modal import (
    ModalParams,
    Row,
    State,
    absorbed,
    begun,
    committed,
    output_row,
    product,
    seen,
)
from pea_core.modal import optimal_gain
from pea_core.params import param
from pea_core.signals import Estimate, Reference

TAKES_MEASUREMENT = True


@dataclass(frozen=True)
class Params(ModalParams):
    """Model, estimator and weight of the effort."""

    effort: float = param(500.0, "", 1e-6, 1e9, help="rho: weight of (K u)^2 beside y^2")


class Coefficients(NamedTuple):
    """Those of `modal`, and the row of the command."""

    of: modal.Coefficients
    g: Row


def design(params: Params, T_s: float) -> Coefficients:
    """Solve both Riccati equations."""
    g = output_row(params, optimal_gain(params.modes, params.effort, T_s), T_s)
    return Coefficients(modal.design(params, T_s, lambda z: [(g, 1.0)]), g)


def start(c: Coefficients) -> State:
    """At rest."""
    return begun(c.of)


def output(c: Coefficients, s: State, W: Reference, W_ff: Reference, x: Estimate) -> float:
    """Feedforward, deviation, command."""
    now = seen(c.of, s, W, W_ff, x.x1)
    return now.u_ff - product(c.of, s, c.g, now)


def update(
    c: Coefficients, s: State, W: Reference, W_ff: Reference, x: Estimate, u: float
) -> State:
    """Keep what was estimated and commanded."""
    return committed(c.of, s, W, W_ff, x.x1, u)


def absorb(c: Coefficients, s: State, gap: float) -> State:
    """Unknown input with which u is higher by `gap` (V)."""
    return absorbed(s, gap)


unlearned = modal.unlearned
