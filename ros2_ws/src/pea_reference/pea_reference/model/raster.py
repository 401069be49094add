r"""Raster: lines forward and backward, one below the other, frame after frame.

With u = f t counted in lines (a line is one way forward and one backward), p its fraction, S the
share of constant velocity, half a line's turn g = (1 - S)/2, and V = 2 `width` / S:

line
    .. math:: \frac{dw}{du} = V \;(p < S/2), \quad
              \frac{dw}{du} = V\,(1 - 2 q(s)), \; s = (p - S/2)/g \;(p < 1/2)

    and its mirror image backward; q is that of `scan`. The part of constant velocity is exactly
    `width` wide. In a turn w goes 0.344 V g beyond it.
frame, step
    Line n is at n `height` / (lines - 1) from the first; w moves by q in the turn after it.
frame, continuous
    w moves by `height` / lines each line, without a stop.

After the last line the frame axis flies back by q over `flyback_lines` lines, while the line axis
goes on; so the line repeats itself for ever. The first line of all is a run-in from rest: the
lines count from u = 1.

Outputs
    `Reference` (m, m/s, m/s^2), exact derivatives, w'' continuous.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pea_core.params import ParameterError, param
from pea_core.signals import Reference
from pea_reference.model.scan import (
    FRAME,
    LINE,
    PIXEL,
    Q_1,
    Q_2,
    Q_3,
    Peaks,
    events_of,
    in_order,
    keep,
    q,
    q_integral,
    samples_enough,
    shared,
)
from pea_reference.model.shaper import Shapeable

PARTS = ("line", "frame")
MOTIONS = ("step", "continuous")

RUN_IN = 0.6875
"""Length of the run-in, in turns: it begins where a turn has its apex."""


@dataclass(frozen=True)
class Params(Shapeable):
    """One axis of a raster."""

    part: str = param("line", choices=PARTS, fixed=True, help="motion of this axis")
    offset_um: float = param(5.0, "um", -1e4, 1e4, help="mean displacement", common=True)
    width_um: float = param(
        8.0, "um", 1e-3, 1e4, help="length of a line, of constant velocity", fixed=True
    )
    height_um: float = param(8.0, "um", 1e-3, 1e4, help="way of the frame axis", fixed=True)
    lines: int = param(
        64, "", 2, 65536, help="lines of a frame, each forward and backward", fixed=True
    )
    pixels: int = param(64, "", 1, 65536, help="pixels of a line, each way", fixed=True)
    line_rate_hz: float = param(
        10.0, "Hz", 1e-4, 1e5, help="lines a second, forward and backward", fixed=True
    )
    line_share: float = param(
        0.8,
        "",
        0.05,
        0.98,
        help="share of a line with constant velocity; the rest are turns",
        fixed=True,
    )
    motion: str = param(
        "step", choices=MOTIONS, help="how the frame axis gets from line to line", fixed=True
    )
    flyback_lines: int = param(
        4, "", 1, 65536, help="lines during which the frame axis goes back", fixed=True
    )


class Coefficients(NamedTuple):
    """Of the scan in lines: share of one way, turn, whole frame; lengths in m.

    V (m): way in a line at the velocity of its middle.  rate (Hz).  step (m): between two lines;
    per line where continuous.
    """

    is_line: bool
    continuous: bool
    offset: float
    width: float
    height: float
    lines: int
    flyback: int
    rate: float
    half: float
    turn: float
    V: float
    step: float
    T_s: float


def design(params: Params, T_s: float) -> Coefficients:
    """Convert to SI and check the pace.

    Raises
    ------
    ParameterError
        The line rate is beyond the stage, or beyond the sample rate.
    """
    rate, turn = params.line_rate_hz, 0.5 * (1.0 - params.line_share)
    samples_enough("line_rate_hz", rate, "Hz", turn / rate, T_s)
    pixel = 0.5 * params.line_share / (rate * params.pixels)
    if pixel < T_s * (1.0 - 1e-9):
        most = int(0.5 * params.line_share / (rate * T_s) * (1.0 + 1e-9))
        raise ParameterError(
            f"pixels = {params.pixels}: a pixel of {pixel:.4g} s is shorter than a sample of "
            f"{T_s:g} s; give at most {most}, or a lower line_rate_hz"
        )
    keep("line_rate_hz", rate, "Hz", params.shaper, bounds(params))
    width, height, continuous = params.width_um * 1e-6, params.height_um * 1e-6, _continuous(params)
    return Coefficients(
        is_line=params.part == "line",
        continuous=continuous,
        offset=params.offset_um * 1e-6,
        width=width,
        height=height,
        lines=params.lines,
        flyback=params.flyback_lines,
        rate=rate,
        half=0.5 * params.line_share,
        turn=turn,
        V=2.0 * width / params.line_share,
        step=height / (params.lines if continuous else params.lines - 1),
        T_s=T_s,
    )


def _continuous(params: Params) -> bool:
    return params.motion == "continuous"


def bounds(params: Params) -> Peaks:
    """Largest velocity, acceleration and jerk of this axis (SI)."""
    g = 0.5 * (1.0 - params.line_share)
    if params.part == "line":
        V = 2e-6 * params.width_um / params.line_share
        one = Peaks(V, 2.0 * Q_1 * V / g, max(2.0, RUN_IN**-2) * Q_2 * V / g**2)
        return one.faster(params.line_rate_hz)
    H, T = params.height_um * 1e-6, float(params.flyback_lines)
    if _continuous(params):
        c = H / params.lines
        way = H + c * T
        one = Peaks(
            max(c, Q_1 * way / T - c),
            max(Q_2 * way / T**2, Q_1 * c),
            max(Q_3 * way / T**3, Q_2 * c),
        )
        return one.faster(params.line_rate_hz)
    moves = ((H / (params.lines - 1), g), (H, T + g))
    one = Peaks(
        *(
            max(factor * way / time**power for way, time in moves)
            for power, factor in enumerate((Q_1, Q_2, Q_3), 1)
        )
    )
    return one.faster(params.line_rate_hz)


scan = shared


def segments(params: Params) -> tuple[tuple[float, float, float], ...]:
    """Start, end and period (s): lines for the line axis, frames for the frame axis."""
    line = 1.0 / params.line_rate_hz
    period = line if params.part == "line" else line * (params.lines + params.flyback_lines)
    return ((line, math.inf, period),)


def events(params: Params, T_s: float, first: int, last: int) -> np.ndarray:
    """Frames, lines each way and their pixels that begin at samples first to last - 1.

    Returns
    -------
    (n,) array
        Of dtype `scan.EVENT`, by sample.
    """
    rate, lines = params.line_rate_hz, params.lines
    whole = lines + params.flyback_lines
    begin = max(math.floor(first * T_s * rate) - 2, 0)
    number = np.arange(begin, max(math.ceil(last * T_s * rate), begin))
    frame, line = np.divmod(number, whole)
    scanned = line < lines
    number, frame, line = number[scanned], frame[scanned], line[scanned]
    new = line == 0
    found = [events_of((number[new] + 1) / rate, T_s, FRAME, frame[new])]
    pixel = np.arange(params.pixels)
    into = pixel * (0.5 * params.line_share / params.pixels)
    for direction, half in ((1, 0.0), (-1, 0.5)):
        u = number + 1.0 + half
        found.append(events_of(u / rate, T_s, LINE, frame, line, direction=direction))
        found.append(
            events_of(
                (u[:, None] + into) / rate,
                T_s,
                PIXEL,
                frame[:, None],
                line[:, None],
                pixel if direction > 0 else pixel[::-1],
                direction,
            )
        )
    return in_order(found, first, last)


def output(c: Coefficients, k: int) -> Reference:
    """Reference at sample k."""
    u = c.rate * (k * c.T_s)
    n = math.floor(u)
    p = u - n
    if c.is_line:
        w, w_1, w_2 = line_at(c, n, p)
    else:
        w, w_1, w_2 = frame_at(c, n, p)
    return Reference(c.offset + w, c.rate * w_1, c.rate * c.rate * w_2)


def line_at(c: Coefficients, n: int, p: float) -> tuple[float, float, float]:
    """The line axis a share p into line n, from the middle, and its derivatives by lines."""
    if n < 1:
        run = RUN_IN * c.turn
        begin = -0.5 * c.width - 0.5 * c.V * run
        s = (p - 1.0 + run) / run
        if s <= 0.0:
            return begin, 0.0, 0.0
        q_0, q_1, _ = q(s)
        return begin + c.V * run * q_integral(s), c.V * q_0, c.V / run * q_1
    back = p >= 0.5
    if back:
        p -= 0.5
    if p < c.half:
        w, w_1, w_2 = c.V * p - 0.5 * c.width, c.V, 0.0
    else:
        s = (p - c.half) / c.turn
        q_0, q_1, _ = q(s)
        w = 0.5 * c.width + c.V * c.turn * (s - 2.0 * q_integral(s))
        w_1 = c.V * (1.0 - 2.0 * q_0)
        w_2 = -2.0 * c.V / c.turn * q_1
    if back:
        return -w, -w_1, -w_2
    return w, w_1, w_2


def frame_at(c: Coefficients, n: int, p: float) -> tuple[float, float, float]:
    """The frame axis a share p into line n, from the middle, and its derivatives by lines."""
    low = -0.5 * c.height
    if n < 1:
        if not c.continuous:
            return low, 0.0, 0.0
        q_0, q_1, _ = q(p)
        return low + c.step * (q_integral(p) - 0.5), c.step * q_0, c.step * q_1
    row = (n - 1) % (c.lines + c.flyback)
    if c.continuous:
        if row < c.lines:
            return low + c.step * (row + p), c.step, 0.0
        T = float(c.flyback)
        s = (row - c.lines + p) / T
        q_0, q_1, q_2 = q(s)
        way = c.height + c.step * T
        return (
            c.step * T * s - low - way * q_0,
            c.step - way / T * q_1,
            -way / (T * T) * q_2,
        )
    start = 1.0 - c.turn
    if row < c.lines - 1:
        w = low + c.step * row
        if p <= start:
            return w, 0.0, 0.0
        T = c.turn
        q_0, q_1, q_2 = q((p - start) / T)
        return w + c.step * q_0, c.step / T * q_1, c.step / (T * T) * q_2
    T = c.flyback + c.turn
    passed = row - (c.lines - 1) + p - start
    if passed <= 0.0:
        return -low, 0.0, 0.0
    q_0, q_1, q_2 = q(passed / T)
    return -low - c.height * q_0, -c.height / T * q_1, -c.height / (T * T) * q_2
