"""NamedTuples of many runs side by side: what a compiled kernel needs to go through them in lanes.

A block of numbers has a row for each number of a NamedTuple and a column for each run, its lane.
The loop over the lanes is the inner one, all its accesses lie side by side, and the compiler lays
neighbouring lanes into one SIMD register where the models' text has nothing but arithmetic;
elsewhere it goes from lane to lane. The models' functions see NamedTuples of numbers and arrays.

An example says what there is: a tree of tuples and NamedTuples whose leaves are numbers, short
arrays and long arrays. A short array is laid into the block like numbers, element by element; of
a long one the block knows where it is. A model finds both as arrays: it may read, write in place
and ask for size, shape and length, and must hand on an array that it was given.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from pea_core.signals import SAMPLE, TRUTH

SHORT = 40
"""Numbers that an array may have to be laid into the block."""

LANES = 16
"""Runs side by side."""


class Known:
    """A boolean that all runs share, known when the kernel is compiled."""

    def __init__(self, value: bool) -> None:
        self.value = value


def example(value: object, fixed: bool = False) -> Any:
    """`value` as an example of its kind: its short arrays as tuples.

    With `fixed` its booleans are those of all runs.
    """
    if isinstance(value, np.ndarray):
        return as_tuple(value.tolist()) if value.size <= SHORT else value
    if isinstance(value, tuple):
        inner = [example(each, fixed) for each in value]
        return type(value)(*inner) if hasattr(value, "_fields") else tuple(inner)
    return Known(value) if fixed and isinstance(value, bool) else value


def as_tuple(values: object) -> Any:
    """Nested lists as nested tuples."""
    return tuple(map(as_tuple, values)) if isinstance(values, list) else values


class Numbers(NamedTuple):
    """Numbers of one run: floats, and integers, booleans and places of arrays."""

    floats: list[float]
    integers: list[int]


def numbers(value: object, fixed: bool = False) -> Numbers:
    """The numbers of a NamedTuple, or of a tuple of them, in the order of a block's rows.

    With `fixed` without its booleans.
    """
    floats: list[float] = []
    integers: list[int] = []
    for leaf in leaves(value):
        if isinstance(leaf, float):
            floats.append(leaf)
        elif isinstance(leaf, np.ndarray):
            if leaf.size <= SHORT:
                floats.extend(leaf.ravel().tolist())
            else:
                strides = (step // leaf.itemsize for step in leaf.strides)
                integers.extend((leaf.ctypes.data, *leaf.shape, *strides))
        elif not (fixed and isinstance(leaf, bool)):
            integers.append(int(leaf))
    return Numbers(floats, integers)


def leaves(value: object) -> list[Any]:
    """What a tree of tuples is made of, in order."""
    if not isinstance(value, tuple):
        return [value]
    found: list[Any] = []
    for each in value:
        if isinstance(each, tuple):
            found += leaves(each)
        else:
            found.append(each)
    return found


def kind(value: object) -> Any:
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


def blocks(values: Sequence[object], fixed: bool = False) -> Blocks:
    """Lay `LANES` values side by side."""
    columns = [numbers(value, fixed) for value in values]
    return Blocks(
        np.array([column.floats for column in columns], np.float64).T.copy(),
        np.array([column.integers for column in columns], np.int64).T.copy(),
    )


SIGNALS = (*(SAMPLE.names or ()), *(TRUTH.names or ()))
"""What a kernel can tell of every sample, in the order of its rows."""


def state(like: Any, lane: int, found: Blocks) -> Any:
    """The numbers of one lane as the NamedTuple that `like`, which has no arrays, is."""
    floats, integers = iter(found.floats[:, lane].tolist()), iter(found.integers[:, lane].tolist())
    return type(like)(
        *(next(floats) if isinstance(x, float) else type(x)(next(integers)) for x in like)
    )
