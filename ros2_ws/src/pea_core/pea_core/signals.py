"""Signals between blocks, one sample each, in SI units (m, m/s, m/s^2, V).

`COLUMNS` is the one table of them: codecs, columns of a trace, units, rows of kernels, reader,
replay, telemetry and dashboard derive from it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pea_core.units import NM_PER_M


class Reference(NamedTuple):
    """Desired displacement W of Eq 3, with the second derivative that Eq 7 needs.

    Attributes
    ----------
    w, w_dot, w_ddot : float
        Desired displacement (m), velocity (m/s), acceleration (m/s^2) at t_k.
    """

    w: float
    w_dot: float
    w_ddot: float


class Measurement(NamedTuple):
    """What the plant tells at t_k.

    Attributes
    ----------
    y : float
        Measured displacement (m).
    y_dot : float
        True velocity (m/s) of an ideal sensor; NaN where the sensor gives none.
    u_applied : float
        Voltage (V) that drove the actuator during the interval that ended at t_k.
    """

    y: float
    y_dot: float
    u_applied: float


class Estimate(NamedTuple):
    """What the observer makes of it at t_k.

    Attributes
    ----------
    x1, x2 : float
        Displacement (m) and velocity (m/s).
    eps : float
        Lumped unknown input (V) of Eq 2.
    """

    x1: float
    x2: float
    eps: float


class Column(NamedTuple):
    """One signal of the loop: where it stands in a trace, and where in a message.

    Attributes
    ----------
    name : str
        Column of a trace.
    unit : str
        SI.
    topic : str
        Topic that carries it, relative to the namespace; its publisher makes the signal.
    field : str
        Field of the topic's messages.
    optional : bool
        Whether messages may lack it; it is NaN then.
    """

    name: str
    unit: str
    topic: str
    field: str
    optional: bool = False


COLUMNS = (
    Column("w", "m", "reference", "positions"),
    Column("w_dot", "m/s", "reference", "velocities"),
    Column("w_ddot", "m/s^2", "reference", "accelerations"),
    Column("y", "m", "displacement", "position"),
    Column("y_dot", "m/s", "displacement", "velocity", optional=True),
    Column("u_applied", "V", "displacement", "effort"),
    Column("x1_hat", "m", "state", "position"),
    Column("x2_hat", "m/s", "state", "velocity"),
    Column("eps_hat", "V", "state", "effort"),
    Column("u", "V", "voltage", "effort"),
)
"""Every signal of a sample: `Reference`, `Measurement`, `Estimate` and the command u_k."""

SIGNAL = Column("signal", "", "signal", "position", optional=True)
"""The sample signal: what a detector measures, in its own unit, one of all axes. Of the blocks none
uses it, so it is no column of a row: it is recorded beside the sample, where a driver has it."""

SAMPLE = np.dtype([(column.name, "<f8") for column in COLUMNS])
"""One sample of the loop, see `COLUMNS`."""

FINE = {"m": ("nm", NM_PER_M), "m/s": ("um/s", 1e6), "m/s^2": ("um/s^2", 1e6), "V": ("V", 1.0)}
"""Unit in which errors are shown to people, by SI unit, and how many of it make one in SI."""

COARSE = {"m": ("um", 1e6), "m/s": ("um/s", 1e6), "m/s^2": ("um/s^2", 1e6), "V": ("V", 1.0)}
"""Unit in which signals are shown to people, likewise."""


def columns_of(topic: str) -> tuple[Column, ...]:
    """Signals that the messages of a topic carry, in the order of their fields."""
    return tuple(column for column in COLUMNS if column.topic == topic)


def column_of(name: str) -> Column:
    """The signal of a name."""
    return COLUMNS[place((name,))[0]]


def place(names: tuple[str, ...]) -> tuple[int, ...]:
    """Columns of a row that hold the signals of these names."""
    return tuple((SAMPLE.names or ()).index(name) for name in names)


_W, _W_DOT, _W_DDOT = place(("w", "w_dot", "w_ddot"))
_Y, _Y_DOT, _U_APPLIED = place(("y", "y_dot", "u_applied"))
_X1, _X2, _EPS = place(("x1_hat", "x2_hat", "eps_hat"))
(_U,) = place(("u",))


Row = np.ndarray | Sequence[float]
"""A row of a trace: a number for each of `COLUMNS`."""


# Kernels pack and unpack rows by the functions that follow, and compile them in.


def pack(
    rows: np.ndarray, r: int, W: Reference, measured: Measurement, estimate: Estimate, u: float
) -> None:
    """Write a sample into row r of an array (n, `COLUMNS`)."""
    rows[r, _W], rows[r, _W_DOT], rows[r, _W_DDOT] = W.w, W.w_dot, W.w_ddot
    rows[r, _Y], rows[r, _Y_DOT] = measured.y, measured.y_dot
    rows[r, _U_APPLIED] = measured.u_applied
    rows[r, _X1], rows[r, _X2] = estimate.x1, estimate.x2
    rows[r, _EPS], rows[r, _U] = estimate.eps, u


def pack_lane(
    rows: np.ndarray,
    i: int,
    lane: int,
    W: Reference,
    measured: Measurement,
    estimate: Estimate,
    u: float,
) -> None:
    """Write a sample of one lane into row i of an array (n, `COLUMNS` and more, lanes)."""
    rows[i, _W, lane], rows[i, _W_DOT, lane], rows[i, _W_DDOT, lane] = W.w, W.w_dot, W.w_ddot
    rows[i, _Y, lane], rows[i, _Y_DOT, lane] = measured.y, measured.y_dot
    rows[i, _U_APPLIED, lane] = measured.u_applied
    rows[i, _X1, lane], rows[i, _X2, lane] = estimate.x1, estimate.x2
    rows[i, _EPS, lane], rows[i, _U, lane] = estimate.eps, u


def pack_estimate(row: np.ndarray, estimate: Estimate) -> None:
    """Write an estimate into a row (`COLUMNS`)."""
    row[_X1], row[_X2], row[_EPS] = estimate.x1, estimate.x2, estimate.eps


def pack_command(row: np.ndarray, u: float) -> None:
    """Write a command into a row (`COLUMNS`)."""
    row[_U] = u


def pack_reference(points: np.ndarray, i: int, W: Reference) -> None:
    """Write a reference into row i of an array (n, 3), or wider."""
    points[i, _W], points[i, _W_DOT], points[i, _W_DDOT] = W.w, W.w_dot, W.w_ddot


def reference_of(points: np.ndarray, i: int) -> Reference:
    """Reference in row i of an array (n, 3), or wider."""
    return Reference(points[i, _W], points[i, _W_DOT], points[i, _W_DDOT])


def reference_of_lane(points: np.ndarray, i: int, lane: int) -> Reference:
    """Reference of one lane in row i of an array (n, 3, lanes)."""
    return Reference(points[i, _W, lane], points[i, _W_DOT, lane], points[i, _W_DDOT, lane])


def measurement_of(row: Row) -> Measurement:
    """Measurement in a row (`COLUMNS`)."""
    return Measurement(row[_Y], row[_Y_DOT], row[_U_APPLIED])


def estimate_of(row: Row) -> Estimate:
    """Estimate in a row (`COLUMNS`)."""
    return Estimate(row[_X1], row[_X2], row[_EPS])


def command_of(row: Row) -> float:
    """Command in a row (`COLUMNS`)."""
    return row[_U]


_TRUE = {"x1": "m", "x2": "m/s", "eps": "V"}

UNITS = {**{column.name: column.unit for column in COLUMNS}, **_TRUE}
"""Unit (SI) of every signal of a sample, and of the truth."""

TRUTH = np.dtype([(name, "<f8") for name in _TRUE])
"""What only a simulated plant knows at t_k: its states and the lumped unknown input."""


def between(a: Reference, b: Reference, theta: float, T_s: float) -> Reference:
    """Reference at the fraction `theta` (0 to 1) of the interval from `a` to `b`.

    Velocity and acceleration come from the cubic that meets both ends' velocities and
    accelerations, displacement from its integral that starts at `a`; the error is of
    order T_s^4 in the velocity.
    """
    h = theta * T_s
    slope = (b.w_dot - a.w_dot) / T_s
    c2 = (3.0 * slope - 2.0 * a.w_ddot - b.w_ddot) / T_s
    c3 = (a.w_ddot + b.w_ddot - 2.0 * slope) / (T_s * T_s)
    return Reference(
        a.w + h * (a.w_dot + h * (a.w_ddot / 2.0 + h * (c2 / 3.0 + h * c3 / 4.0))),
        a.w_dot + h * (a.w_ddot + h * (c2 + h * c3)),
        a.w_ddot + h * (2.0 * c2 + h * 3.0 * c3),
    )


KINDS = ("frame", "line", "pixel", "point")
"""Kinds of a scan's events, by their numbers."""
