r"""Levels one after the other: staircases, slow triangles, steps of several sizes and back.

From `start_um` w goes to each level in its `move_s` and stays there for its `hold_s`. With s the
share of the move that has passed and a the way to go,

minimum_jerk
    .. math:: a\,(10 s^3 - 15 s^4 + 6 s^5)
linear
    .. math:: a\,s, \quad \dot w = a / t_m

A move of 0 s is a raw step: its derivatives are given as zero. After the last level w stays.
Times are rounded to whole samples.

Outputs
    `Reference` (m, m/s, m/s^2), exact derivatives; those of `linear` are not continuous.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pea_core.params import ParameterError, param
from pea_core.signals import Reference

SHAPES = ("minimum_jerk", "linear")
MINIMUM_JERK, LINEAR = range(2)


@dataclass(frozen=True)
class Params:
    """A staircase: levels, the time to each of them, the time at each of them."""

    start_um: float = param(0.0, "um", -1e4, 1e4, help="displacement before the first move")
    levels_um: tuple[float, ...] = param((5.0,), "um", -1e4, 1e4, help="levels in turn")
    move_s: tuple[float, ...] = param(
        (0.1,), "s", 0.0, 1e4, help="time to each level, or to all; 0: a raw step"
    )
    hold_s: tuple[float, ...] = param((0.1,), "s", 0.0, 1e5, help="time at each level, or at all")
    shape: str = param("minimum_jerk", choices=SHAPES, help="how w gets from level to level")

    def __post_init__(self) -> None:
        count = len(self.levels_um)
        if not count:
            raise ParameterError("levels_um is empty: give at least one value")
        for name in ("move_s", "hold_s"):
            if len(getattr(self, name)) not in (1, count):
                raise ParameterError(
                    f"{name} has {len(getattr(self, name))} values: give one, or one for each of "
                    f"the {count} levels_um"
                )


class Coefficients(NamedTuple):
    """Of each level (n): level before and level (m), first sample, samples to get there.

    shape: its number.  T_s (s).
    """

    before: np.ndarray
    after: np.ndarray
    first: np.ndarray
    moving: np.ndarray
    shape: int
    T_s: float


def times(params: Params, T_s: float) -> tuple[np.ndarray, np.ndarray, int]:
    """First sample of each move, first sample at each level, and the end of the last hold."""
    count = len(params.levels_um)
    move, hold = (
        np.round(np.broadcast_to(each, count) / T_s).astype(int)
        for each in (params.move_s, params.hold_s)
    )
    ends = np.cumsum(move + hold)
    first = np.concatenate([[0], ends[:-1]])
    return first, first + move, int(ends[-1])


def design(params: Params, T_s: float) -> Coefficients:
    """Convert to SI and to samples."""
    first, there, _ = times(params, T_s)
    levels = np.array([params.start_um, *params.levels_um]) * 1e-6
    shape = SHAPES.index(params.shape)
    return Coefficients(levels[:-1].copy(), levels[1:].copy(), first, there - first, shape, T_s)


def output(c: Coefficients, k: int) -> Reference:
    """Reference at sample k."""
    low, high = 0, c.first.size
    while high - low > 1:
        middle = (low + high) // 2
        if k < c.first[middle]:
            high = middle
        else:
            low = middle
    before, after = float(c.before[low]), float(c.after[low])
    n, i = float(c.moving[low]), float(k - c.first[low])
    if i >= n:
        return Reference(after, 0.0, 0.0)
    way, s = after - before, i / n
    t = n * c.T_s
    if c.shape == LINEAR:
        return Reference(before + way * s, way / t, 0.0)
    return Reference(
        before + way * (s * s * s * (10.0 + s * (-15.0 + s * 6.0))),
        way / t * (s * s * (30.0 + s * (-60.0 + s * 30.0))),
        way / (t * t) * (s * (60.0 + s * (-180.0 + s * 120.0))),
    )
