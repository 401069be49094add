r"""Points from a file, in turn, each for its dwell time, with jerk-limited moves between them.

The file is text with a head that names its columns: one of positions for each axis, and `dwell`.

    x [um],y [um],dwell [s]
    1.0,2.0,0.01
    4.0,2.5,0.02

Units: m, mm, um, nm; s, ms, us. Without one: um and s. `part` is the name of this axis's column.

Between two points all axes move along a straight line, by the S-curve of the longest way among
them (`shaper`): within ``shaper.velocity_max``, ``acceleration_max``, ``jerk_max``, ``slew_rate``
and ``current_max``, no shorter than ``shaper.move_time``, and once for each impulse where a shaper
is on. So they arrive together. The first point holds from the first sample. After the last the
scan goes back to the first (`repeat`), or stays.

Outputs
    `Reference` (m, m/s, m/s^2), exact derivatives, w'' continuous.
"""

import csv
import functools
import math
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pea_core import tables
from pea_core.params import ParameterError, nearest, number_of, param
from pea_core.paths import bytes_of, given
from pea_core.signals import Reference
from pea_reference.model.scan import FRAME, POINT, events_of, in_order, shared
from pea_reference.model.shaper import NO_MOVE, Curve, Shapeable, curve, done, impulses

DWELL = "dwell"
"""Name of the column of times."""


@dataclass(frozen=True)
class Params(Shapeable):
    """One axis of a list of points."""

    path: str = param("", help="text file of points and dwell times", fixed=True)
    part: str = param("x", help="column of this axis in the file, by its name", fixed=True)
    repeat: bool = param(True, help="whether it goes from the last point to the first", fixed=True)


class Coefficients(NamedTuple):
    """Points (n) in m, when each is left (s), S-curve (m, 3) of each move, impulses, period (s)."""

    w: np.ndarray
    left: np.ndarray
    kept: np.ndarray
    t: np.ndarray
    A: np.ndarray
    period: float
    T_s: float


class Points(NamedTuple):
    """Contents of a file: names of the columns, positions (n, columns) in um, dwell (n) in s."""

    names: tuple[str, ...]
    position: np.ndarray
    dwell: np.ndarray


def read(path: Path, where: str) -> Points:
    """Read a file of points.

    Raises
    ------
    ParameterError
        It cannot be read; the text names the line, the rule and what to do.
    """
    try:
        stat = path.stat()
        return _read(path, stat.st_mtime_ns, stat.st_size, where)
    except OSError as error:
        raise ParameterError(f"{where}: {error.strerror}") from None


@functools.lru_cache(maxsize=8)
def _read(path: Path, changed_ns: int, size: int, where: str) -> Points:
    try:
        text = bytes_of(path, what=where).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise ParameterError(f"{where}: is no UTF-8 text") from None
    numbered = enumerate(text.splitlines(), 1)
    lines = [(i, line) for i, line in numbered if line.strip() and not line.startswith("#")]
    if not lines:
        raise ParameterError(f"{where}: is empty; its first line names the columns")
    separator = next((each for each in ";\t" if each in lines[0][1]), ",")
    try:
        rows = [(i, next(csv.reader([line], delimiter=separator))) for i, line in lines]
    except csv.Error:
        raise ParameterError(f"{where}: is no text of separated values") from None
    names, scales = _head(rows[0][1], where)
    values = np.array([_row(i, row, names, where) for i, row in rows[1:]]).reshape(-1, len(names))
    if not len(values):
        raise ParameterError(f"{where}: has no point; give one a line, below the names")
    values *= scales
    at = names.index(DWELL)
    short = np.flatnonzero(values[:, at] < 0.0)
    if short.size:
        raise ParameterError(f"{where}: line {rows[1 + short[0]][0]} has a dwell below 0 s")
    others = tuple(name for name in names if name != DWELL)
    return Points(others, np.delete(values, at, axis=1), values[:, at])


def _head(cells: list[str], where: str) -> tuple[list[str], list[float]]:
    """Names of the columns, and the factor of each to um and s."""
    names, scales = [], []
    for cell in cells:
        found = re.fullmatch(r"([A-Za-z]\w*?)\s*(?:[\[(]([^\])]*)[\])])?", cell.strip())
        if found is None:
            raise ParameterError(
                f"{where}: {cell.strip()!r} is no name of a column; the first line is like "
                f"'x [um],y [um],{DWELL} [s]'"
            )
        name, unit = found[1], found[2]
        quantity = tables.TIME if name == DWELL else tables.LENGTH
        scale = quantity.scale(unit.strip()) if unit else 1
        if scale is None:
            known = "s, ms or us" if name == DWELL else "m, mm, um or nm"
            raise ParameterError(f"{where}: column {name} has unit {unit!r}; give {known}")
        names.append(name)
        scales.append(float(scale))
    for name in names:
        if names.count(name) > 1:
            raise ParameterError(f"{where}: column {name} is there twice; give each another name")
    if DWELL not in names or len(names) < 2:
        raise ParameterError(
            f"{where}: has the columns {', '.join(names)}; give one of positions for each axis, "
            f"and {DWELL}"
        )
    return names, scales


def _row(number: int, cells: list[str], names: list[str], where: str) -> list[float]:
    """Numbers of a line."""
    if len(cells) != len(names):
        raise ParameterError(
            f"{where}: line {number} has {len(cells)} values, but there are {len(names)} columns"
        )
    values = []
    for cell, name in zip(cells, names, strict=True):
        value = number_of(cell.strip())
        if value is None or not math.isfinite(value):
            raise ParameterError(
                f"{where}: line {number}: {name} = {cell.strip()!r}: give a finite number"
            )
        values.append(float(value))
    return values


FILE = "path"
"""Parameter that names the file."""


def text(values: Mapping[str, Any]) -> str:
    """The file that the values of the parameters name, as text that reads the same."""
    found = read(Path(values["path"]), values["path"])
    rows = np.column_stack([found.position, found.dwell]).tolist()
    head = ",".join([*(f"{name} [um]" for name in found.names), f"{DWELL} [s]"])
    return "\n".join([head, *(",".join(map(repr, row)) for row in rows)]) + "\n"


def understood(params: Params) -> str:
    """One line on how the file was read."""
    found = read(Path(params.path).expanduser(), params.path)
    return f"{len(found.dwell)} points of {', '.join(found.names)} in um, {DWELL} in s"


class PointPlan(NamedTuple):
    """When the points of a file are reached and left (s), by which moves; of all axes."""

    points: Points
    reached: np.ndarray
    left: np.ndarray
    moves: list[Curve]
    kind: tuple[np.ndarray, np.ndarray]
    period: float


def plan(params: Params) -> PointPlan:
    """Times and moves of a list.

    Raises
    ------
    ParameterError
        As `read`.
    """
    path = given(params.path, "path")
    if not params.path:
        raise ParameterError(f"path = '': give a CSV file with columns of positions and {DWELL}")
    points = read(path, f"path = '{path}'")
    shaper = params.shaper
    kind = impulses(shaper) if shaper.on else (NO_MOVE.t, NO_MOVE.A)
    where = points.position
    following = np.roll(where, -1, axis=0) if params.repeat else where[1:]
    ways = np.abs(following - where[: len(following)]).max(axis=1)
    moves = [curve(shaper, way * 1e-6, kind) if way else NO_MOVE for way in ways]
    lengths = np.array([move.length for move in moves])
    ends = np.cumsum(points.dwell[: len(moves)] + lengths)
    reached = np.concatenate([[0.0], ends])[: len(where)]
    period = float(ends[-1]) if params.repeat else math.inf
    return PointPlan(points, reached, reached + points.dwell, moves, kind, period)


def design(params: Params, T_s: float) -> Coefficients:
    """Read the file and plan the moves.

    Raises
    ------
    ParameterError
        As `read`; no such column; a list that takes no time.
    """
    found = plan(params)
    if params.part not in found.points.names:
        raise ParameterError(
            f"part = {params.part!r}: no column of path = '{params.path}': "
            f"{nearest(params.part, found.points.names)}"
        )
    if found.period < T_s:
        raise ParameterError(
            f"path = '{params.path}': its points take {found.period:g} s, less than a sample of "
            f"{T_s:g} s; give a longer dwell, or repeat = false"
        )
    w = found.points.position[:, found.points.names.index(params.part)] * 1e-6
    kept = np.array([(m.T_j, m.T_a, m.T_v) for m in found.moves]).reshape(-1, 3)
    return Coefficients(w, found.left, kept, *found.kind, found.period, T_s)


def scan(params: Params) -> dict[str, Any]:
    """The parameters that must be the same for all axes, those of the moves among them."""
    moves = {f"shaper.{name}": value for name, value in asdict(params.shaper).items()}
    return {**shared(params), **{n: v for n, v in moves.items() if n != "shaper.rest_um"}}


def segments(params: Params) -> tuple[tuple[float, float, float], ...]:
    """Start, end and period (s) of a list that repeats."""
    return ((0.0, math.inf, plan(params).period),) if params.repeat else ()


def events(params: Params, T_s: float, first: int, last: int) -> np.ndarray:
    """Rounds as frames, and each point (as pixel) that w reaches at samples first to last - 1.

    Returns
    -------
    (n,) array
        Of dtype `scan.EVENT`, by sample.
    """
    found = plan(params)
    if params.repeat:
        rounds = np.arange(
            max(math.floor(first * T_s / found.period) - 1, 0),
            math.ceil(last * T_s / found.period) + 1,
        )
        begin = rounds[:, None] * found.period
    else:
        rounds, begin = np.zeros(1, dtype=int), np.zeros((1, 1))
    number = np.arange(len(found.reached))
    reached = begin + found.reached
    return in_order(
        [
            events_of(begin[:, 0], T_s, FRAME, rounds),
            events_of(reached, T_s, POINT, rounds[:, None], pixel=number),
        ],
        first,
        last,
    )


def output(c: Coefficients, k: int) -> Reference:
    """Reference at sample k."""
    t = k * c.T_s
    if c.period < math.inf:
        t %= c.period
    low, high = -1, c.left.size
    while high - low > 1:  # the last point that has been left
        middle = (low + high) // 2
        if t < c.left[middle]:
            high = middle
        else:
            low = middle
    if low < 0:
        return Reference(float(c.w[0]), 0.0, 0.0)
    if low >= c.kept.shape[0]:
        return Reference(float(c.w[low]), 0.0, 0.0)
    before, after = float(c.w[low]), float(c.w[(low + 1) % c.w.size])
    row = c.kept[low]
    f, f_1, f_2 = done(Curve(row[0], row[1], row[2], c.t, c.A), t - float(c.left[low]))
    way = after - before
    return Reference(before + way * f, way * f_1, way * f_2)
