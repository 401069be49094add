"""NamedTuples of many runs side by side: what a compiled kernel needs to go through them in lanes.

A block of numbers has a row for each number of a NamedTuple and a column for each run, its lane.
The loop over the lanes is the inner one, all its accesses lie side by side, and the compiler lays
neighbouring lanes into one SIMD register where the models' text has nothing but arithmetic;
elsewhere it goes from lane to lane. The models' functions see NamedTuples of numbers and arrays.

An example says what there is: a tree of tuples and NamedTuples whose leaves are numbers, short
arrays and long arrays. A short array is laid into the block like numbers, element by element; of
a long one the block knows where it is. A model finds both as arrays: it may read, write in place
and ask for the size, and must hand on an array that it was given.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from pea_core.compiled import compile_kernel, open_sources
from pea_core.signals import SAMPLE, TRUTH, Reference, between

SHORT = 40
"""Numbers that an array may have to be laid into the block."""

LANES = 16
"""Runs side by side."""


class Known:
    """A boolean that all runs share, known when the kernel is compiled."""

    def __init__(self, value: bool) -> None:
        self.value = value


def example(value: Any, fixed: bool = False) -> Any:
    """`value` as an example of its kind: its short arrays as tuples.

    With `fixed` its booleans are those of all runs.
    """
    if isinstance(value, np.ndarray):
        return as_tuple(value.tolist()) if value.size <= SHORT else value
    if isinstance(value, tuple):
        inner = [example(each, fixed) for each in value]
        return type(value)(*inner) if hasattr(value, "_fields") else tuple(inner)
    return Known(value) if fixed and isinstance(value, bool) else value


def as_tuple(values: Any) -> Any:
    """Nested lists as nested tuples."""
    return tuple(map(as_tuple, values)) if isinstance(values, list) else values


class Numbers(NamedTuple):
    """Numbers of one run: floats, and integers, booleans and places of arrays."""

    floats: list[float]
    integers: list[int]


def numbers(value: Any, fixed: bool = False) -> Numbers:
    """The numbers of a NamedTuple, or of a tuple of them, in the order of a block's rows.

    With `fixed` without its booleans.
    """
    found = Numbers([], [])
    for leaf in leaves(value):
        if isinstance(leaf, np.ndarray):
            if leaf.size <= SHORT:
                found.floats.extend(leaf.ravel().tolist())
            else:
                found.integers.extend((leaf.ctypes.data, leaf.size))
        elif isinstance(leaf, float):
            found.floats.append(leaf)
        elif not (fixed and isinstance(leaf, bool)):
            found.integers.append(int(leaf))
    return found


def leaves(value: Any) -> Iterator[Any]:
    """What a tree of tuples is made of, in order."""
    if isinstance(value, tuple):
        for each in value:
            yield from leaves(each)
    else:
        yield value


def kind(value: Any) -> Any:
    """What has to be alike for coefficients to lie side by side in a block."""
    if isinstance(value, tuple):
        return type(value), tuple(map(kind, value))
    if isinstance(value, np.ndarray):
        return ("short", value.shape) if value.size <= SHORT else ("long", value.ndim)
    return value if isinstance(value, bool) else type(value)


class Blocks(NamedTuple):
    """Numbers of L runs.

    floats : (rows, L) array of float64
    integers : (rows, L) array of int64
    """

    floats: np.ndarray
    integers: np.ndarray


def blocks(values: Sequence[Any], fixed: bool = False) -> Blocks:
    """Lay `LANES` values side by side."""
    columns = [numbers(value, fixed) for value in values]
    return Blocks(
        np.array([column.floats for column in columns], np.float64).T.copy(),
        np.array([column.integers for column in columns], np.int64).T.copy(),
    )


@cache
def access() -> tuple[Any, Any]:
    """What a kernel takes a lane's tuples out of the blocks with, and puts its states back with.

    Returns
    -------
    take
        ``take(like, floats, integers, l, L)``: the tuples of lane l of L.
    put
        ``put(like, floats, integers, l, L, value)``: the numbers of `value` into lane l;
        arrays have been written in place.
    """
    from pea_core.lanes_native import put, take

    return take, put


SIGNALS = (*(SAMPLE.names or ()), *(TRUTH.names or ()))
"""What a kernel can tell of every sample, in the order of its rows."""


def lanes_kernel(
    plant: Any, observer: Any, controller: Any, score: Any, each: bool, traced: bool
) -> Callable[..., Any]:
    """Compile the tick of `Loop` for three models, over samples and, within each, over lanes.

    Parameters
    ----------
    plant, observer, controller : module
        Models (`pea_core.block`), the plant's with ``truth``.
    score : module
        Offers ``update(c, s, counts, W, truth, measured, estimate, u)``, see `pea_runtime.score`.
    each : bool
        Whether every lane has a reference of its own.
    traced : bool
        Whether every sample is told.

    Returns
    -------
    callable
        ``kernel(like_c, like_s, c floats, c integers, s floats, s integers, bad, k, points,
        ahead, theta, T_s, noise, counts, rows)`` takes the lanes n = len(noise) samples further.
        `points` (n and the preview, 3, lanes or 1), `noise` (n, lanes), `counts` (n, lanes or 1),
        `rows` (n, len(SIGNALS), lanes). `bad` (lanes) gets the first sample, counted from k, at
        which a command was no number; that lane goes on with 0 V.
    """
    p_output, p_update, p_truth = plant.output, plant.update, plant.truth
    o_output, o_update = observer.output, observer.update
    c_output, c_update = controller.output, controller.update
    score_update, lumped = score.update, score.lumped
    take, put = access()
    sources = open_sources(
        *(p_output, p_update, p_truth, o_output, o_update, c_output, c_update),
        *(score_update, lumped, between),
    )

    def kernel(
        like_c: Any,
        like_s: Any,
        c_floats: np.ndarray,
        c_integers: np.ndarray,
        s_floats: np.ndarray,
        s_integers: np.ndarray,
        bad: np.ndarray,
        k: int,
        points: np.ndarray,
        ahead: int,
        theta: float,
        T_s: float,
        noise: np.ndarray,
        counts: np.ndarray,
        rows: np.ndarray,
    ) -> None:
        sources  # noqa: B018  part of the key under which the result is kept
        for i in range(len(noise)):
            j = i + ahead
            for lane in range(LANES):
                p, o, c, m = take(like_c, c_floats, c_integers, lane, LANES)
                s_p, s_o, s_c, s_m = take(like_s, s_floats, s_integers, lane, LANES)
                r = lane if each else 0
                W = Reference(points[i, 0, r], points[i, 1, r], points[i, 2, r])
                W_ff = Reference(points[j, 0, r], points[j, 1, r], points[j, 2, r])
                if theta != 0.0:
                    W_after = Reference(
                        points[j + 1, 0, r], points[j + 1, 1, r], points[j + 1, 2, r]
                    )
                    W_ff = between(W_ff, W_after, theta, T_s)
                measured = p_output(p, s_p, noise[i, lane])
                estimate = o_output(o, s_o, measured)
                u = c_output(c, s_c, W, W_ff, estimate)
                if not math.isfinite(u):
                    bad[lane] = min(bad[lane], k + i)
                    u = 0.0
                true = p_truth(p, s_p)
                s_m = score_update(m, s_m, counts[i, r], W, true, measured, estimate, u)
                if traced:
                    rows[i, 0, lane] = W.w
                    rows[i, 1, lane] = W.w_dot
                    rows[i, 2, lane] = W.w_ddot
                    rows[i, 3, lane] = measured.y
                    rows[i, 4, lane] = measured.y_dot
                    rows[i, 5, lane] = measured.u_applied
                    rows[i, 6, lane] = estimate.x1
                    rows[i, 7, lane] = estimate.x2
                    rows[i, 8, lane] = estimate.eps
                    rows[i, 9, lane] = u
                    rows[i, 10, lane] = true.x1
                    rows[i, 11, lane] = true.x2
                    rows[i, 12, lane] = lumped(m, true, measured.u_applied)
                s_p = p_update(p, s_p, noise[i, lane], measured, u)
                s_o = o_update(o, s_o, measured, estimate)
                s_c = c_update(c, s_c, W, W_ff, estimate, u)
                put(like_s, s_floats, s_integers, lane, LANES, (s_p, s_o, s_c, s_m))

    return compile_kernel(kernel, error_model="numpy")


def state(like: Any, lane: int, found: Blocks) -> Any:
    """The numbers of one lane as the NamedTuple that `like`, which has no arrays, is."""
    floats, integers = iter(found.floats[:, lane].tolist()), iter(found.integers[:, lane].tolist())
    return type(like)(
        *(next(floats) if isinstance(x, float) else type(x)(next(integers)) for x in like)
    )
