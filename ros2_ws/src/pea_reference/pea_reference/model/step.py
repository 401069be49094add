r"""Step: w jumps from offset to offset + amplitude at the sample nearest to `time`.

Raw: its derivatives are given as zero, though none exist at the jump, so the feedforward of
Eq 7 sees the level alone.

Outputs
    `Reference` (m, m/s, m/s^2).
"""

from dataclasses import dataclass
from typing import NamedTuple

from pea_core.params import param
from pea_core.signals import Reference


@dataclass(frozen=True)
class Params:
    """One jump."""

    amplitude_um: float = param(5.0, "um", -1e4, 1e4, help="height of the step")
    offset_um: float = param(0.0, "um", -1e4, 1e4, help="displacement before the step")
    time: float = param(0.0, "s", 0.0, 1e6, help="when the step comes")


class Coefficients(NamedTuple):
    """Levels (m) and the sample at which they change."""

    before: float
    after: float
    k_step: int


def design(params: Params, T_s: float) -> Coefficients:
    """Convert to SI and to samples."""
    before = params.offset_um * 1e-6
    return Coefficients(before, before + params.amplitude_um * 1e-6, round(params.time / T_s))


def output(c: Coefficients, k: int) -> Reference:
    """Reference at sample k."""
    return Reference(c.before if k < c.k_step else c.after, 0.0, 0.0)
