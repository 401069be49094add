"""No hysteresis: v = u."""

from dataclasses import dataclass
from typing import NamedTuple

ABSENT = True


@dataclass(frozen=True)
class Params:
    """No parameters."""


class Coefficients(NamedTuple):
    """One gain, for compiled code that cannot hold an empty tuple."""

    gain: float


class State(NamedTuple):
    """Effective voltage v (V)."""

    v: float


def design(params: Params, T_s: float) -> Coefficients:
    """Unit gain."""
    return Coefficients(1.0)


def start(c: Coefficients) -> State:
    """At rest, v = 0."""
    return State(0.0)


def output(c: Coefficients, s: State) -> float:
    """Effective voltage v (V)."""
    return s.v


def update(c: Coefficients, s: State, u: float) -> State:
    """v = u."""
    return State(c.gain * u)
