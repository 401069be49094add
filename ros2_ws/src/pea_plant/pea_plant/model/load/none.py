"""No external load."""

from dataclasses import dataclass
from typing import NamedTuple


@dataclass(frozen=True)
class Params:
    """No parameters."""


class Coefficients(NamedTuple):
    """The load (V), for compiled code that cannot hold an empty tuple."""

    f_e: float


def design(params: Params, T_s: float, K: float) -> Coefficients:
    """Zero."""
    return Coefficients(0.0)


def output(c: Coefficients, k: int) -> float:
    """Volts-equivalent load (V) at sample k."""
    return c.f_e
