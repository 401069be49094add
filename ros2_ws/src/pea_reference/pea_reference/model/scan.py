r"""What scans share: smooth motion, the limits of the stage, and events.

A scan moves several axes. Each axis has a reference of its own: the same type, the same
parameters, and `part`, which says which motion of the scan is its own. `shared` are the parameters
that must be the same for all of them.

Motions are joined by the polynomial

.. math:: q(s) = 10 s^3 - 15 s^4 + 6 s^5, \quad 0 \le s \le 1

from 0 to 1, whose first two derivatives are 0 at both ends, and by its integral. So w'' is
continuous and the jerk is bounded.

Limits are those of a shaped move (`shaper`): ``velocity_max``, ``acceleration_max``, ``jerk_max``,
``slew_rate``, ``current_max``. Where they are given, a scan keeps them or is refused, whether or
not a shaper is on. The voltage that Eq 7 asks for changes by at most

.. math:: (\max|w'''| + 2 \zeta \omega_n \max|w''| + \omega_n^2 \max|w'|) / (K \omega_n^2)
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any, NamedTuple

import numpy as np

from pea_core.params import ParameterError
from pea_core.signals import KINDS
from pea_reference.model.shaper import ShaperParams, rate_of

FRAME, LINE, PIXEL, POINT = range(len(KINDS))
"""Numbers of the kinds of events."""

EVENT = np.dtype(
    [
        ("k", np.int64),
        ("kind", np.uint8),
        ("frame", np.int64),
        ("line", np.int64),
        ("pixel", np.int64),
        ("direction", np.int8),
    ]
)
"""An event: its sample, its number in `KINDS`, the indices of frame, line and pixel that begins,
and the direction of the line: 1 forward, -1 backward, 0 where it has none. -1 is no line or pixel.

``pixel`` counts along the axis, so it falls from event to event on a backward line.
"""

Q_1 = 1.875
"""Largest q'."""
Q_2 = 10.0 / math.sqrt(3.0)
"""Largest |q''|."""
Q_3 = 60.0
"""Largest |q'''|."""

OWN = ("part", "offset_um", "shaper")
"""Parameters of one axis; all others are of the scan."""

TURN_SAMPLES = 4
"""Fewest samples of the shortest motion of a scan."""


class Peaks(NamedTuple):
    """Largest |w'|, |w''| and |w'''| (m/s, m/s^2, m/s^3)."""

    velocity: float
    acceleration: float
    jerk: float

    def faster(self, factor: float) -> Peaks:
        """Those of the same path in 1/factor of the time."""
        return Peaks(self.velocity * factor, self.acceleration * factor**2, self.jerk * factor**3)


def q(s: float) -> tuple[float, float, float]:
    """From 0 to 1 over s from 0 to 1, and its derivatives."""
    return (
        s * s * s * (10.0 + s * (-15.0 + s * 6.0)),
        s * s * (30.0 + s * (-60.0 + s * 30.0)),
        s * (60.0 + s * (-180.0 + s * 120.0)),
    )


def q_integral(s: float) -> float:
    """Integral of `q` from 0 to s; 1/2 at s = 1."""
    return s * s * s * s * (2.5 + s * (-3.0 + s))


def shared(params: Any) -> dict[str, Any]:
    """The parameters of a scan that must be the same for all its axes."""
    return {
        field.name: getattr(params, field.name)
        for field in dataclasses.fields(params)
        if field.name not in OWN
    }


def voltage_rate(shaper: ShaperParams, peaks: Peaks) -> float:
    """Bound of |du/dt| of Eq 7 (V/s)."""
    return max(
        (peaks.jerk + 2.0 * zeta * omega * peaks.acceleration + omega**2 * peaks.velocity)
        / (shaper.K * 1e-6 * omega**2)
        for omega, zeta in zip(shaper.omega_n, shaper.zeta, strict=True)
    )


def pace(shaper: ShaperParams, peaks: Peaks) -> tuple[float, str]:
    """How many times as fast a scan may be, and what it meets first; inf where nothing limits it.

    Parameters
    ----------
    shaper : ShaperParams
        Limits, 0 for none.
    peaks : Peaks
        Of the scan as it is.
    """
    found = [(math.inf, "")]
    units = ("um/s", "um/s^2", "um/s^3")
    for power, (name, value) in enumerate(peaks._asdict().items(), 1):
        limit = getattr(shaper, f"{name}_max") * 1e-6
        if limit > 0.0 and value > 0.0:
            text = (
                f"its {name} of {value * 1e6:.4g} {units[power - 1]} is above shaper.{name}_max = "
                f"{limit * 1e6:g}"
            )
            found.append(((limit / value) ** (1.0 / power), text))
    if rate := rate_of(shaper):
        value = voltage_rate(shaper, peaks)
        name = "slew_rate" if rate == shaper.slew_rate else "current_max / capacitance"
        text = f"its voltage changes by up to {value:.4g} V/s, above shaper.{name} = {rate:g}"
        found.append((_pace_of_voltage(shaper, peaks, rate), text))
    return min(found)


def _pace_of_voltage(shaper: ShaperParams, peaks: Peaks, rate: float) -> float:
    """How many times as fast a scan may be for its voltage."""
    if not any(peaks):
        return math.inf
    low, high = 0.0, 1.0
    while voltage_rate(shaper, peaks.faster(high)) < rate:
        low, high = high, 2.0 * high
    for _ in range(60):
        middle = 0.5 * (low + high)
        if voltage_rate(shaper, peaks.faster(middle)) <= rate:
            low = middle
        else:
            high = middle
    return low


def keep(name: str, value: float, unit: str, shaper: ShaperParams, peaks: Peaks) -> None:
    """Refuse a scan that is faster than the stage.

    Parameters
    ----------
    name, value, unit
        The parameter that sets its pace: a rate in Hz, or a time in s.
    shaper, peaks
        As for `pace`.

    Raises
    ------
    ParameterError
        It passes a limit; the text says the nearest value that does not.
    """
    factor, text = pace(shaper, peaks)
    if factor >= 1.0:
        return
    raise ParameterError(
        f"{name} = {value:g}: beyond the stage: {text}; {works(value, factor, unit)}"
    )


def works(value: float, factor: float, unit: str) -> str:
    """The nearest value of a rate (Hz) or of a time (s) that works, in words."""
    if unit == "s":
        return f"give it at least {rounded(value / factor, up=True)} s"
    return f"give it at most {rounded(value * factor, up=False)} {unit}"


def rounded(value: float, up: bool) -> str:
    """A number with four digits that is not below (`up`), or not above, a value."""
    step = 10.0 ** (math.floor(math.log10(value)) - 3)
    count = math.ceil(value / step - 1e-9) if up else math.floor(value / step + 1e-9)
    return f"{count * step:.4g}"


def samples_enough(name: str, value: float, unit: str, shortest: float, T_s: float) -> None:
    """Refuse a scan whose shortest motion takes fewer than `TURN_SAMPLES` samples.

    Raises
    ------
    ParameterError
        It does; the text says the nearest value that does not.
    """
    least = TURN_SAMPLES * T_s
    if shortest < least * (1.0 - 1e-9):
        raise ParameterError(
            f"{name} = {value:g}: its shortest motion takes {shortest:.4g} s, less than "
            f"{TURN_SAMPLES} samples of {T_s:g} s; {works(value, shortest / least, unit)}"
        )


def samples_of(t: np.ndarray, T_s: float) -> np.ndarray:
    """First sample at or after each time (s)."""
    found: np.ndarray = np.ceil(t / T_s - 1e-6).astype(np.int64)
    return found


def events_of(
    t: Any, T_s: float, kind: int, frame: Any, line: Any = -1, pixel: Any = -1, direction: Any = 0
) -> np.ndarray:
    """Events at times t (s), of dtype `EVENT`; the others are arrays or one value for all."""
    t = np.asarray(t, dtype=float)
    found = np.empty(t.shape, EVENT)
    found["k"] = samples_of(t, T_s)
    for name, values in (
        ("kind", kind), ("frame", frame), ("line", line), ("pixel", pixel), ("direction", direction)
    ):  # fmt: skip
        found[name] = values
    return found.ravel()


def in_order(parts: list[np.ndarray], first: int, last: int) -> np.ndarray:
    """Events of the samples first to last - 1, by sample; at one sample frame, line, pixel."""
    found = np.concatenate([np.empty(0, EVENT), *parts])
    found = found[(found["k"] >= first) & (found["k"] < last)]
    order: np.ndarray = found[np.lexsort((found["kind"], found["k"]))]
    return order
