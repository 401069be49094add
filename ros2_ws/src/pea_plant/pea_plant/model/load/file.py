"""Load from a text file with two columns, time (s) and value, linear between its points.

`pea_core.tables` says what is understood. Times must rise; they count from the start of the loop,
or, where the first is a time of day, from the first. Before the first and after the last point
their values hold.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pea_core import tables
from pea_core.params import ParameterError, param
from pea_plant.model.load.common import LoadParams, volts

MOST_SAMPLES = 20_000_000
"""Longest load kept in memory, in samples."""

OF_DAY = 1e6
"""A first time (s) from which on it is a time of day: no loop lasts so long."""

LARGEST = 1e9
"""Largest value, V or N."""


@dataclass(frozen=True)
class Params(LoadParams):
    """Where the file is."""

    path: str = param("", help="text file, time (s) and value (V or N)", fixed=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.path:
            raise ParameterError("path = '': name a text file with time (s) and value")


class Coefficients(NamedTuple):
    """Load (n) in V at samples 0 to n-1; the last value holds."""

    f_e: np.ndarray


def read(params: Params) -> tables.Table:
    """The file's times (s) and values, in the load's unit.

    Raises
    ------
    ParameterError
        As the reader; less than two lines, or a value that no load has.
    """
    where = f"load.path = {params.path!r}"
    quantity = tables.FORCE if params.unit == "N" else tables.VOLTAGE
    found = tables.read(Path(params.path), where, quantity)
    if len(found.time) < 2:
        raise ParameterError(f"{where}: has {len(found.time)} points, two are needed")
    if np.abs(found.value).max() > LARGEST:
        raise ParameterError(f"{where}: numbers must be finite, values within {LARGEST:g}")
    return found


def loop_time(table: tables.Table) -> np.ndarray:
    """Times since the start of the loop (s); a time of day counts from the first line."""
    return table.stamp if table.stamp[0] < OF_DAY else table.time


FILE = "path"
"""Parameter that names the file."""


def table(values: Mapping[str, Any]) -> tuple[tables.Table, str]:
    """The file that the values of the parameters name, and the heading of its values."""
    unit, stiffness = values["unit"], values["stiffness"]
    found = read(Params(path=values["path"], unit=unit, stiffness=stiffness))
    return found._replace(time=loop_time(found)), f"value [{unit}]"


def understood(params: Params) -> str:
    """One line on how the file was read."""
    return read(params).understood


def design(params: Params, T_s: float, K: float) -> Coefficients:
    """Sample the file and convert to volts, with V's steady-state gain K (um/V)."""
    found = read(params)
    time = loop_time(found)
    samples = max(time[-1] / T_s, 0.0)
    if samples > MOST_SAMPLES:
        raise ParameterError(
            f"load.path = {params.path!r}: lasts {time[-1]:g} s, at most "
            f"{MOST_SAMPLES * T_s:g} s are allowed at this sample period"
        )
    t = np.arange(math.ceil(samples) + 1) * T_s
    return Coefficients(np.interp(t, time, found.value) * volts(params, K))


def output(c: Coefficients, k: int) -> float:
    """Volts-equivalent load (V) at sample k."""
    return c.f_e[min(k, c.f_e.size - 1)]
