r"""Extended-state observer on modes behind a delay: eps and eps' as further states.

Model, delays and prediction are those of `modes`. The poles of the error lie where a Butterworth
filter of bandwidth omega_o and as many poles as there are states has them.

Inputs
    `Measurement` (m, V).
Outputs
    `Estimate` (m, m/s, V).
State
    see `modes`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from pea_core.params import param
from pea_core.signals import Estimate, Measurement
from pea_observer.model import modes
from pea_observer.model.modes import Coefficients, State, begun, estimated, kept


@dataclass(frozen=True)
class Params(modes.ModesParams):
    """Model, sensor's delay and bandwidth."""

    PRESET: ClassVar[str] = "extended_state_modal"

    omega_o: float = param(3000.0, "rad/s", 10.0, 1e6, help="bandwidth of the error's poles")


def design(params: Params, T_s: float) -> Coefficients:
    """Place the poles."""
    return modes.designed(params, modes.placed(params.modes, params.omega_o, T_s), T_s)


def start(c: Coefficients) -> State:
    """At rest, no unknown input."""
    return begun(c)


def output(c: Coefficients, s: State, measured: Measurement) -> Estimate:
    """Predict, correct, and predict to the present."""
    return estimated(c, s, measured)


def update(c: Coefficients, s: State, measured: Measurement, estimate: Estimate) -> State:
    """Keep the corrected estimate and the voltage."""
    return kept(c, s, measured)
