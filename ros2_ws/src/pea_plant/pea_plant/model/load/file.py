"""Load from a CSV file with two columns, time (s) and value, linear between its points.

A first line that is no pair of numbers is a heading; empty lines and lines after ``#`` are
passed over. Times must rise. Before the first and after the last point their values hold.
"""

from __future__ import annotations

import csv
import functools
import math
import os
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pea_core.params import ParameterError, param
from pea_plant.model.load.common import LoadParams, volts

MOST_SAMPLES = 20_000_000
"""Longest load kept in memory, in samples."""

LARGEST = 1e9
"""Largest value, V or N."""


@dataclass(frozen=True)
class Params(LoadParams):
    """Where the file is."""

    path: str = param("", help="CSV file, time (s) and value (V or N)", fixed=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.path:
            raise ParameterError("path = '': name a CSV file with time (s) and value")


class Coefficients(NamedTuple):
    """Load (n) in V at samples 0 to n-1; the last value holds."""

    f_e: np.ndarray


def points(path: str) -> np.ndarray:
    """Times (s) and values of the file, (n, 2).

    Raises
    ------
    ParameterError
        It cannot be read, a line is no pair of finite numbers, there are less than two
        points, or times do not rise.
    """
    try:
        stat = os.stat(path)
        return _points(path, stat.st_mtime_ns, stat.st_size)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        reason = getattr(error, "strerror", None) or error
        raise ParameterError(f"load.path = {path!r}: cannot be read ({reason})") from None


@functools.lru_cache(maxsize=8)
def _points(path: str, changed_ns: int, size: int) -> np.ndarray:
    found: list[tuple[float, float]] = []
    with open(path, encoding="utf-8-sig", newline="") as file:
        for number, row in enumerate(csv.reader(file), 1):
            if not "".join(row).strip() or row[0].lstrip().startswith("#"):
                continue
            try:
                time, value = (float(text) for text in row)
            except ValueError:
                if number == 1:
                    continue
                raise _wrong(path, number, "two numbers, time (s) and value, are needed") from None
            if not (math.isfinite(time) and abs(value) <= LARGEST):
                raise _wrong(path, number, f"numbers must be finite, values within {LARGEST:g}")
            if found and time <= found[-1][0]:
                raise _wrong(path, number, f"time {time:g} s does not rise")
            found.append((time, value))
    if len(found) < 2:
        raise ParameterError(f"load.path = {path!r}: has {len(found)} points, two are needed")
    return np.array(found)


def _wrong(path: str, number: int, rule: str) -> ParameterError:
    return ParameterError(f"load.path = {path!r}: line {number}: {rule}")


def design(params: Params, T_s: float, K: float) -> Coefficients:
    """Sample the file and convert to volts, with V's steady-state gain K (um/V)."""
    time, value = points(params.path).T
    samples = max(time[-1] / T_s, 0.0)
    if samples > MOST_SAMPLES:
        raise ParameterError(
            f"load.path = {params.path!r}: lasts {time[-1]:g} s, at most "
            f"{MOST_SAMPLES * T_s:g} s are allowed at this sample period"
        )
    t = np.arange(math.ceil(samples) + 1) * T_s
    return Coefficients(np.interp(t, time, value) * volts(params, K))


def output(c: Coefficients, k: int) -> float:
    """Volts-equivalent load (V) at sample k."""
    return c.f_e[min(k, c.f_e.size - 1)]
