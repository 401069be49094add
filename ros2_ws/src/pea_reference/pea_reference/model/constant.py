r"""Constant: w = offset.

Outputs
    `Reference` (m, m/s, m/s^2).
"""

from dataclasses import dataclass
from typing import NamedTuple

from pea_core.params import param
from pea_core.signals import Reference
from pea_reference.model.shaper import Shapeable


@dataclass(frozen=True)
class Params(Shapeable):
    """One level."""

    offset_um: float = param(0.0, "um", -1e4, 1e4, help="displacement", common=True)


class Coefficients(NamedTuple):
    """Displacement (m)."""

    offset: float


def design(params: Params, T_s: float) -> Coefficients:
    """Convert to SI."""
    return Coefficients(params.offset_um * 1e-6)


def move(params: Params) -> tuple[float, float]:
    """When (s) the last level begins, and that level (m)."""
    return 0.0, params.offset_um * 1e-6


def output(c: Coefficients, k: int) -> Reference:
    """Reference at sample k."""
    return Reference(c.offset, 0.0, 0.0)
