r"""Levels one after the other: staircases, slow triangles, steps of several sizes and back.

From `start_um` w goes to each level in its `move_s` and stays there for its `hold_s`. With s the
share of the move that has passed and a the way to go,

minimum_jerk
    .. math:: a\,(10 s^3 - 15 s^4 + 6 s^5)
linear
    .. math:: a\,s, \quad \dot w = a / t_m

A move of 0 s is a raw step, whose derivatives are given as zero; with a shaper (`shaper`) it is a
shaped move, and the hold must be as long. After the last level w stays.
Times are rounded to whole samples.

Outputs
    `Reference` (m, m/s, m/s^2), exact derivatives; those of `linear` are not continuous.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pea_core.params import ParameterError, param
from pea_core.signals import Reference
from pea_reference.model.shaper import NO_MOVE, Curve, Shapeable, curve, done, impulses

SHAPES = ("minimum_jerk", "linear")
MINIMUM_JERK, LINEAR = range(2)


@dataclass(frozen=True)
class Params(Shapeable):
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

    shape: its number.  T_s (s).  kept (n, 3): S-curve of each shaped move, see `shaper`, 0 where
    it is none.  t, A: impulses.
    """

    before: np.ndarray
    after: np.ndarray
    first: np.ndarray
    moving: np.ndarray
    shape: int
    T_s: float
    kept: np.ndarray
    t: np.ndarray
    A: np.ndarray


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
    kept, t, A = shaped(params, levels, times(params, T_s), T_s)
    before, after = levels[:-1].copy(), levels[1:].copy()
    return Coefficients(before, after, first, there - first, shape, T_s, kept, t, A)


def shaped(
    params: Params, levels: np.ndarray, when: tuple[np.ndarray, np.ndarray, int], T_s: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """S-curves (n, 3) of the raw steps, and the impulses; zeros without a shaper.

    Raises
    ------
    ParameterError
        A level is held for less than the move to it takes.
    """
    first, there, end = when
    kept = np.zeros((first.size, 3))
    if not params.shaper.on:
        return kept, NO_MOVE.t, NO_MOVE.A
    kind = impulses(params.shaper)
    for i, (start, until) in enumerate(zip(first, [*first[1:], end], strict=True)):
        if there[i] > start or levels[i + 1] == levels[i]:
            continue
        move = curve(params.shaper, levels[i + 1] - levels[i], kind)
        if move.length > (until - start) * T_s and i + 1 < first.size:
            raise ParameterError(
                f"hold_s = {list(params.hold_s)}: the shaped move to level {i + 1} takes "
                f"{move.length:.3g} s; hold it for longer"
            )
        kept[i] = move.T_j, move.T_a, move.T_v
    return kept, *kind


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
    if c.kept[low, 1] > 0.0:
        row = c.kept[low]
        f, f_1, f_2 = done(Curve(row[0], row[1], row[2], c.t, c.A), i * c.T_s)
        if f < 1.0:
            way = after - before
            return Reference(before + way * f, way * f_1, way * f_2)
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
