"""The metrics of a run, sample by sample: what a sweep keeps of each run instead of its trace.

A block like any other (`pea_core.block`), so that a sweep's kernel can carry it along. The scoring
rule is that of `pea_experiment.metrics`; sums are in the order of the samples.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

from pea_core.nominal import NominalModel
from pea_core.signals import Estimate, Measurement, Reference
from pea_core.units import NM_PER_M

UNITS = {
    "rms_error_nm": "nm",
    "max_error_nm": "nm",
    "rms_error_percent": "%",
    "rms_voltage_step_V": "V",
    "saturated_samples": "",
    "eps_max_V": "V",
    "eps_left_max_V": "V",
    "observer_rms_x1_nm": "nm",
    "observer_rms_x2_um_s": "um/s",
    "observer_rms_eps_V": "V",
}
"""The metrics, as in ``metrics.json``, and their units."""


class Coefficients(NamedTuple):
    """Eq 2 of the observer's nominal model in SI; what the actuator can apply (V)."""

    A21: float
    A22: float
    B2: float
    voltage_min: float
    voltage_max: float


class State(NamedTuple):
    """Sums of squares (e, x1, x2, eps, step) and largest values over the samples that count.

    n, steps : samples and steps in the sums.  u : last command (V).  counted : whether its sample
    counts.  saturated : commands beyond the limits.  eps_max, eps_left_max (V): of all samples.
    """

    e: float
    e_max: float
    x1: float
    x2: float
    eps: float
    n: int
    step: float
    steps: int
    u: float
    counted: bool
    saturated: int
    eps_max: float
    eps_left_max: float


def design(nominal: NominalModel, voltage_min: float, voltage_max: float) -> Coefficients:
    """Coefficients from the observer's model and the plant's limits (V)."""
    return Coefficients(nominal.A21, nominal.A22, nominal.B2, voltage_min, voltage_max)


def start(c: Coefficients) -> State:
    """Nothing counted yet."""
    return State(0.0, 0.0, 0.0, 0.0, 0.0, 0, 0.0, 0, 0.0, False, 0, 0.0, 0.0)


def lumped(c: Coefficients, true: Any, u_applied: float) -> float:
    """eps (V) of Eq 2 from the true states (m, m/s, m/s^2)."""
    return float((true.x2_dot - c.A21 * true.x1 - c.A22 * true.x2) / c.B2 - u_applied)


def update(
    c: Coefficients,
    s: State,
    counts: bool,
    W: Reference,
    true: Any,
    measured: Measurement,
    x: Estimate,
    u: float,
) -> State:
    """Take one sample in; `counts` says whether it is scored."""
    eps = lumped(c, true, measured.u_applied)
    weight = 1.0 if counts else 0.0
    error = weight * (true.x1 - W.w)
    x1, x2, left = weight * (x.x1 - true.x1), weight * (x.x2 - true.x2), x.eps - eps
    step = u - s.u if s.counted else 0.0
    return State(
        s.e + error * error,
        max(s.e_max, abs(error)),
        s.x1 + x1 * x1,
        s.x2 + x2 * x2,
        s.eps + (weight * left) * (weight * left),
        s.n + (1 if counts else 0),
        s.step + step * step,
        s.steps + (1 if s.counted else 0),
        u,
        counts,
        s.saturated + (1 if u < c.voltage_min or u > c.voltage_max else 0),
        max(s.eps_max, abs(eps)),
        max(s.eps_left_max, abs(left)),
    )


def figures(s: State, amplitude: float) -> Mapping[str, float]:
    """The metrics of a run that has ended.

    Parameters
    ----------
    s : State
    amplitude : float
        Half the stroke of the reference over the samples that count (m).
    """
    n = max(s.n, 1)
    error = math.sqrt(s.e / n)
    return dict(
        zip(
            UNITS,
            (
                error * NM_PER_M,
                s.e_max * NM_PER_M,
                100.0 * error / amplitude if amplitude > 0.0 else math.nan,
                math.sqrt(s.step / max(s.steps, 1)),
                float(s.saturated),
                s.eps_max,
                s.eps_left_max,
                math.sqrt(s.x1 / n) * NM_PER_M,
                math.sqrt(s.x2 / n) * 1e6,
                math.sqrt(s.eps / n),
            ),
            strict=True,
        )
    )
