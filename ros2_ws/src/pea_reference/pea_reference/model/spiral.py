r"""Spiral of Archimedes from the middle outward, at constant angular or constant linear velocity.

.. math:: x = r \cos\theta, \quad y = r \sin\theta, \quad r = b\,\theta, \quad
          b = \frac{\text{diameter}}{4 \pi\,\text{turns}}

in three parts, which together take `frame_time_s` and repeat themselves for ever:

start
    From rest over `inner_turns`; theta is the polynomial of degree five that joins the next part.
scan, angular
    .. math:: \dot\theta = \omega
scan, linear
    .. math:: \frac{b}{2}\bigl(\theta \sqrt{1 + \theta^2} + \operatorname{asinh}\theta\bigr) = v\,t,
              \quad \dot\theta = \frac{v}{b \sqrt{1 + \theta^2}}

    so the speed along the path is exactly v. theta is found by Newton's method.
return
    theta goes on at the last acceleration for `return_turns` turns at the last velocity, while r
    goes back to 0 by a polynomial of degree five, that joins r, r' and r'' and ends with r = r' =
    r'' = 0. There x, y and both their derivatives are 0, so the next frame joins without a jump.

Outputs
    `Reference` (m, m/s, m/s^2), exact derivatives, w'' continuous.
"""

import math
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np

from pea_core.params import ParameterError, param
from pea_core.signals import Reference
from pea_reference.model.scan import (
    FRAME,
    LINE,
    Peaks,
    events_of,
    in_order,
    keep,
    samples_enough,
    shared,
)
from pea_reference.model.shaper import Shapeable

PARTS = ("x", "y")
VELOCITIES = ("angular", "linear")

TURNS_MAX = 10_000

BEGIN = {"angular": 2.0, "linear": 1.5}
"""Length of the start, in inner turns at the angular velocity that it ends with."""

LOOKS = 400
"""Times at which each part of a spiral is looked at."""

SLACK = 1.01
"""By how much its peaks may lie above those that are looked at."""

NEWTON = 6
"""Steps from the first guess, which is right to 1/theta^2; two are enough beyond one turn."""


@dataclass(frozen=True)
class Params(Shapeable):
    """One axis of a spiral."""

    part: str = param("x", choices=PARTS, fixed=True, help="motion of this axis")
    offset_um: float = param(5.0, "um", -1e4, 1e4, help="mean displacement", common=True)
    diameter_um: float = param(8.0, "um", 1e-3, 1e4, help="of the last turn", fixed=True)
    turns: int = param(
        16, "", 2, TURNS_MAX, help="turns outward, those of the start included", fixed=True
    )
    inner_turns: int = param(1, "", 1, TURNS_MAX, help="turns of the smooth start", fixed=True)
    return_turns: int = param(2, "", 1, TURNS_MAX, help="turns of the way back", fixed=True)
    velocity: str = param(
        "angular", choices=VELOCITIES, help="what is constant while it scans", fixed=True
    )
    frame_time_s: float = param(
        2.0, "s", 1e-4, 1e6, help="time of a frame, way back included", fixed=True
    )

    def __post_init__(self) -> None:
        for name in ("inner_turns", "return_turns"):
            if getattr(self, name) >= self.turns:
                raise ParameterError(
                    f"{name} = {getattr(self, name)}: must be less than turns = {self.turns}; give "
                    f"at most {self.turns - 1}"
                )


class Coefficients(NamedTuple):
    """Parts of a spiral in units of the frame time F (s) and of the largest radius.

    t_1, t_2: ends of start and scan.  a3, a4, a5: polynomial of the start, theta over t/t_1.
    turn_1 (rad): theta at t_1.  speed: of theta where angular, along the path where linear.  path:
    length at t_1.  turn_2, rate_2, rise_2: theta and its derivatives at t_2.  r3, r4, r5:
    polynomial of r, over what is left of the return.
    """

    is_y: bool
    linear: bool
    offset: float
    radius: float
    F: float
    b: float
    t_1: float
    t_2: float
    a3: float
    a4: float
    a5: float
    turn_1: float
    speed: float
    path: float
    turn_2: float
    rate_2: float
    rise_2: float
    r3: float
    r4: float
    r5: float
    T_s: float


def design(params: Params, T_s: float) -> Coefficients:
    """Convert to SI and check the pace.

    Raises
    ------
    ParameterError
        The frame time is too short for the stage, or for the sample rate.
    """
    c = parts(params.turns, params.inner_turns, params.return_turns, params.velocity)
    F, name = params.frame_time_s, "frame_time_s"
    quarter = 0.5 * math.pi / max(c.rate_2, rate_at(c, c.turn_1))
    samples_enough(name, F, "s", quarter * F, T_s)
    if any(limits(params)):
        keep(name, F, "s", params.shaper, bounds(params))
    return c._replace(
        is_y=params.part == "y",
        offset=params.offset_um * 1e-6,
        radius=0.5e-6 * params.diameter_um,
        F=F,
        T_s=T_s,
    )


def limits(params: Params) -> tuple[float, ...]:
    """Limits of the shaper, 0 for none; the peaks are looked for where there is one."""
    s = params.shaper
    return s.velocity_max, s.acceleration_max, s.jerk_max, s.slew_rate, s.current_max


def quintic(a: float, b: float, c: float) -> tuple[float, float, float]:
    """Coefficients of s^3, s^4 and s^5 that give a value, slope and curvature at s = 1."""
    return (
        10.0 * a - 4.0 * b + 0.5 * c,
        -15.0 * a + 7.0 * b - c,
        6.0 * a - 3.0 * b + 0.5 * c,
    )


def arc(theta: float) -> float:
    """Length of r = theta from the middle."""
    return 0.5 * (theta * math.sqrt(1.0 + theta * theta) + math.asinh(theta))


@cache
def parts(turns: int, inner: int, back: int, velocity: str) -> Coefficients:
    """A spiral of radius 1 in time 1."""
    linear = velocity == "linear"
    whole = 2.0 * math.pi
    turn_1, turn_2 = whole * inner, whole * turns
    b = 1.0 / turn_2
    root_1, root_2 = (math.sqrt(1.0 + turn * turn) for turn in (turn_1, turn_2))
    if linear:
        lengths = (
            BEGIN[velocity] * turn_1 * root_1,
            arc(turn_2) - arc(turn_1),
            whole * back * root_2,
        )
        v = b * sum(lengths)
        times = [b * length / v for length in lengths]
        rate_1, rate_2 = v / (b * root_1), v / (b * root_2)
        rise_1 = -rate_1 * rate_1 * turn_1 / root_1**2
        rise_2 = -rate_2 * rate_2 * turn_2 / root_2**2
        speed = v
    else:
        angles = (BEGIN[velocity] * turn_1, turn_2 - turn_1, whole * back)
        speed = rate_1 = rate_2 = sum(angles)
        times = [angle / speed for angle in angles]
        rise_1 = rise_2 = 0.0
    t_1, T_back = times[0], times[2]
    a = quintic(turn_1, rate_1 * t_1, rise_1 * t_1 * t_1)
    r = quintic(1.0, -b * rate_2 * T_back, b * rise_2 * T_back**2)
    return Coefficients(
        False, linear, 0.0, 1.0, 1.0, b, t_1, times[0] + times[1], *a, turn_1, speed,
        b * arc(turn_1), turn_2, rate_2, rise_2, *r, 1.0,
    )  # fmt: skip


def rate_at(c: Coefficients, theta: float) -> float:
    """Angular velocity of the scan at an angle."""
    return c.speed / (c.b * math.sqrt(1.0 + theta * theta)) if c.linear else c.speed


@cache
def peaks(turns: int, inner: int, back: int, velocity: str) -> Peaks:
    """Largest velocity, acceleration and jerk along a spiral of radius 1 in time 1."""
    c = parts(turns, inner, back, velocity)
    largest = [0.0, 0.0, 0.0]
    for start, end in ((0.0, c.t_1), (c.t_1, c.t_2), (c.t_2, 1.0)):
        h = (end - start) / LOOKS
        for i in range(LOOKS):
            a, m, z = (polar(c, start + h * (i + f)) for f in (1e-3, 0.5, 1.0 - 1e-3))
            r, r_1, r_2, _, o, o_1 = m
            span = h * (1.0 - 2e-3)
            r_3, o_2 = (z[2] - a[2]) / span, (z[5] - a[5]) / span
            rows = (
                (r_1, r * o),
                (r_2 - r * o * o, r * o_1 + 2.0 * r_1 * o),
                (
                    r_3 - 3.0 * r_1 * o * o - 3.0 * r * o * o_1,
                    3.0 * r_2 * o + 3.0 * r_1 * o_1 + r * o_2 - r * o**3,
                ),
            )
            largest = [max(old, math.hypot(*row)) for old, row in zip(largest, rows, strict=True)]
    return Peaks(*(SLACK * value for value in largest))


def bounds(params: Params) -> Peaks:
    """Largest velocity, acceleration and jerk along the path (SI), which no axis passes."""
    found = peaks(params.turns, params.inner_turns, params.return_turns, params.velocity)
    radius = 0.5e-6 * params.diameter_um
    return Peaks(*(radius * value for value in found)).faster(1.0 / params.frame_time_s)


scan = shared


def segments(params: Params) -> tuple[tuple[float, float, float], ...]:
    """Start, end and period (s) of the frames, which repeat without end."""
    return ((0.0, math.inf, params.frame_time_s),)


def events(params: Params, T_s: float, first: int, last: int) -> np.ndarray:
    """Frames, and the turns of the scan as lines, that begin at samples first to last - 1.

    Returns
    -------
    (n,) array
        Of dtype `scan.EVENT`, by sample.
    """
    F = params.frame_time_s
    c = parts(params.turns, params.inner_turns, params.return_turns, params.velocity)
    frame = np.arange(max(math.floor(first * T_s / F) - 1, 0), math.ceil(last * T_s / F) + 1)
    line = np.arange(params.inner_turns, params.turns)
    theta = 2.0 * math.pi * line
    if c.linear:
        lengths = np.array([c.b * arc(float(angle)) for angle in theta])
        t: np.ndarray = c.t_1 + (lengths - c.path) / c.speed
    else:
        t = c.t_1 + (theta - c.turn_1) / c.speed
    return in_order(
        [
            events_of(frame * F, T_s, FRAME, frame),
            events_of((frame[:, None] + t) * F, T_s, LINE, frame[:, None], line, direction=1),
        ],
        first,
        last,
    )


def polar(c: Coefficients, t: float) -> tuple[float, float, float, float, float, float]:
    """r, theta and their two derivatives each at t (frames) of radius 1: r, r', r'', theta ..."""
    if t < c.t_1:
        s = t / c.t_1
        th = s * s * s * (c.a3 + s * (c.a4 + s * c.a5))
        th_1 = s * s * (3.0 * c.a3 + s * (4.0 * c.a4 + s * 5.0 * c.a5)) / c.t_1
        th_2 = s * (6.0 * c.a3 + s * (12.0 * c.a4 + s * 20.0 * c.a5)) / (c.t_1 * c.t_1)
    elif t < c.t_2:
        if c.linear:
            way = (c.path + c.speed * (t - c.t_1)) / c.b
            th = math.sqrt(2.0 * way)
            for _ in range(NEWTON):
                th -= (arc(th) - way) / math.sqrt(1.0 + th * th)
            square = 1.0 + th * th
            th_1 = c.speed / (c.b * math.sqrt(square))
            th_2 = -th_1 * th_1 * th / square
        else:
            th, th_1, th_2 = c.turn_1 + c.speed * (t - c.t_1), c.speed, 0.0
    else:
        after = t - c.t_2
        th = c.turn_2 + after * (c.rate_2 + 0.5 * after * c.rise_2)
        T = 1.0 - c.t_2
        s = (1.0 - t) / T
        return (
            s * s * s * (c.r3 + s * (c.r4 + s * c.r5)),
            -s * s * (3.0 * c.r3 + s * (4.0 * c.r4 + s * 5.0 * c.r5)) / T,
            s * (6.0 * c.r3 + s * (12.0 * c.r4 + s * 20.0 * c.r5)) / (T * T),
            th,
            c.rate_2 + after * c.rise_2,
            c.rise_2,
        )
    return c.b * th, c.b * th_1, c.b * th_2, th, th_1, th_2


def output(c: Coefficients, k: int) -> Reference:
    """Reference at sample k."""
    frames = k * c.T_s / c.F
    r, r_1, r_2, th, th_1, th_2 = polar(c, frames - math.floor(frames))
    cos, sin = math.cos(th), math.sin(th)
    along, across = r_2 - r * th_1 * th_1, r * th_2 + 2.0 * r_1 * th_1
    if c.is_y:
        w, w_1, w_2 = r * sin, r_1 * sin + r * th_1 * cos, along * sin + across * cos
    else:
        w, w_1, w_2 = r * cos, r_1 * cos - r * th_1 * sin, along * cos - across * sin
    v = c.radius / c.F
    return Reference(c.offset + c.radius * w, v * w_1, v / c.F * w_2)
