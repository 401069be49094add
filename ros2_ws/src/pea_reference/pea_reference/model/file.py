r"""Displacement from a file, as a spline through its points.

A text file has two columns, time (s) and w (um) where its head gives no other units
(`pea_core.tables`); time rises from line to line, at any distances. Time 0 of the loop is the
first line's time. Of a bag, the positions on `topic` are taken, by the stamps in its messages
(`bag`).

Between the points w is a polynomial of degree five (or three) in each interval,

.. math:: w = \sum_{j=0}^{5} a_{ij}\,(t - t_i)^j, \quad t_i \le t < t_{i+1}

that meets its neighbours with four (two) continuous derivatives; w' and w'' are those of the
polynomial. At the ends:

rest
    w' = 0 (and w'' = 0 where quintic) at both ends, then the last value for ever. A file that
    starts or ends moving gets ripple over the first or last few points.
free
    no condition (not-a-knot); after the end the last value, so a file that ends moving stops
    with a jump of w'.
periodic
    the last value must be the first; the file repeats, and so do all derivatives.

Outputs
    `Reference` (m, m/s, m/s^2), exact derivatives of the spline.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pea_core import tables
from pea_core.params import ParameterError, param
from pea_core.paths import given
from pea_core.signals import Reference
from pea_reference.model.bag import read_bag
from pea_reference.model.shaper import Shapeable

DEGREES = {"cubic": 3, "quintic": 5}

SUFFIXES = (".csv", ".tsv", ".txt", ".dat")
"""Ends of the names of text files."""

CLOSED = 1e-6
"""Share of the stroke by which the ends of a periodic file may differ: rounding in its text."""


@dataclass(frozen=True)
class Params(Shapeable):
    """A file and how to read between its lines."""

    path: str = param(
        "", help="text file of time (s) and displacement (um), or a bag's directory", fixed=True
    )
    topic: str = param("/pea/displacement", help="topic of a bag with the positions", fixed=True)
    spline: str = param("quintic", help="polynomials between the points", choices=tuple(DEGREES))
    ends: str = param("rest", help="what is before and after", choices=("rest", "free", "periodic"))


class Coefficients(NamedTuple):
    """Knots t (n + 1) from 0 (s), a (n, 6) of each interval (m/s^j), last value (m), period (s)."""

    t: np.ndarray
    a: np.ndarray
    w_end: float
    periodic: bool
    T_s: float


def read(path: Path, topic: str) -> tables.Table:
    """Time (s) and displacement (um), of a text file or of a bag's topic.

    Raises
    ------
    ParameterError
        As the reader, or a file of another kind.
    """
    if path.is_dir():
        return read_bag(path, topic)
    if path.suffix.lower() in SUFFIXES:
        return tables.read(path, f"path = '{path}'", tables.LENGTH)
    raise ParameterError(
        f"path = '{path}': cannot read '{path.suffix}' files, give a .csv, .tsv, .txt or "
        ".dat file, or the directory of a bag"
    )


FILE = "path"
"""Parameter that names the file."""


def table(values: Mapping[str, Any]) -> tuple[tables.Table, str]:
    """The file that the values of the parameters name, and the heading of its values."""
    return read(Path(values["path"]), values["topic"]), "w [um]"


def understood(params: Params) -> str:
    """One line on how the file was read."""
    return read(Path(params.path).expanduser(), params.topic).understood


def design(params: Params, T_s: float) -> Coefficients:
    """Read the file and fit the spline.

    Raises
    ------
    ParameterError
        As the reader; unknown kind of file; too few points; not periodic where it should be.
    """
    from scipy.interpolate import PPoly, make_interp_spline  # slow to import

    path, degree = given(params.path, "path"), DEGREES[params.spline]
    if not params.path:
        raise ParameterError("path = '': give a CSV file of time (s) and w (um), or a bag")
    table = read(path, params.topic)
    t, w = table.time, table.value
    if len(t) <= degree:
        raise ParameterError(
            f"path = '{path}': {len(t)} points are too few, a {params.spline} spline needs "
            f"{degree + 1}"
        )
    periodic = params.ends == "periodic"
    if periodic:
        if abs(w[-1] - w[0]) > CLOSED * np.ptp(w):
            raise ParameterError(
                f"path = '{path}': ends at {w[-1]:.10g} um, but starts at {w[0]:.10g} um: "
                f"ends = 'periodic' needs both to be the same, to {CLOSED:g} of the stroke"
            )
        w = np.append(w[:-1], w[0])  # what is left of the difference is rounding
    scale = t[-1] / (len(t) - 1)  # of order one between points, whatever the unit of time
    rest = [(j, 0.0) for j in range(1, (degree + 1) // 2)]
    ends = {"rest": (rest, rest), "free": None, "periodic": "periodic"}[params.ends]
    pieces = PPoly.from_spline(make_interp_spline(t / scale, w * 1e-6, k=degree, bc_type=ends))
    inside = slice(degree, len(pieces.x) - 1 - degree)
    knots = pieces.x[degree : len(pieces.x) - degree]
    a = np.zeros((len(knots) - 1, 6))
    for j in range(degree + 1):
        a[:, j] = pieces.c[degree - j, inside] / scale**j
    return Coefficients(knots * scale, a, w[-1] * 1e-6, periodic, T_s)


def segments(params: Params) -> tuple[tuple[float, float, float], ...]:
    """Start, end and period (s) of a periodic file: one without end."""
    if params.ends != "periodic":
        return ()
    return ((0.0, math.inf, float(read(Path(params.path).expanduser(), params.topic).time[-1])),)


def output(c: Coefficients, k: int) -> Reference:
    """Reference at sample k."""
    t = k * c.T_s
    end = float(c.t[c.t.size - 1])
    if c.periodic:
        t %= end
    elif t >= end:
        return Reference(c.w_end, 0.0, 0.0)
    low, high = 0, c.t.size - 1
    while high - low > 1:
        middle = (low + high) // 2
        if t < c.t[middle]:
            high = middle
        else:
            low = middle
    h = t - float(c.t[low])
    w = w_dot = w_ddot = 0.0
    for j in range(5, -1, -1):  # Horner, and its derivatives
        w_ddot = w_ddot * h + 2.0 * w_dot
        w_dot = w_dot * h + w
        w = w * h + float(c.a[low, j])
    return Reference(w, w_dot, w_ddot)
