r"""What a device's numbers mean: polynomials between its units and volts and micrometres.

.. math:: command = \sum_i a_i u^i, \quad y = \sum_i s_i\, reading^i

u (V) is the voltage at the actuator, y (um) its displacement. Offset first, then gain; what
comes after bends the line. Each must rise or fall all over its range, so that it has an inverse.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from pea_core.params import ParameterError, param

TOL = 1e-13
"""What a term must add over the range, relative to the largest: less is none."""

TURNS = 60
"""Halvings at most when a curve is inverted: beyond the digits of a float."""


@dataclass(frozen=True)
class Params:
    """Calibration; the default takes a device at its word: its volts, its micrometres."""

    amplifier: tuple[float, ...] = param(
        (0.0, 1.0), "", -1e9, 1e9, help="device command of V: offset, gain, ...", fixed=True
    )
    sensor: tuple[float, ...] = param(
        (0.0, 1.0), "", -1e9, 1e9, help="um of the device's reading: offset, gain, ...", fixed=True
    )


class CalibrationCurve:
    """A polynomial that is monotone over a range, and its inverse.

    Parameters
    ----------
    name : str
        Parameter that it comes from, for errors.
    coefficients : sequence of float
        Offset first.
    low, high : float
        Range of its argument.
    scale : float
        Factor on its values, for units.

    Raises
    ------
    ParameterError
        It is not strictly monotone there.
    """

    def __init__(
        self,
        name: str,
        coefficients: tuple[float, ...],
        low: float,
        high: float,
        scale: float = 1.0,
    ) -> None:
        polynomial = np.polynomial.Polynomial([scale * a for a in coefficients or (0.0,)])
        even = polynomial.convert(domain=[low, high])  # argument from -1 to 1: terms compare
        even = even.trim(TOL * float(np.max(np.abs(even.coef))))
        slope = even.deriv()
        roots = np.asarray(slope.roots(), complex)
        turning = [float(r.real) for r in roots if abs(r.imag) <= 1e-9 * (high - low)]
        inside = [r for r in turning if low < r < high]
        signs = {float(np.sign(slope(x))) for x in _between([low, *sorted(inside), high])}
        if signs not in ({1.0}, {-1.0}):
            where = f" (it turns at {inside[0]:.4g})" if inside else ""
            raise ParameterError(
                f"{name} = {list(coefficients)}: must rise or fall all over {low:g} to "
                f"{high:g}{where}; give another polynomial, offset first"
            )
        self.low, self.high = low, high
        polynomial = polynomial.cutdeg(even.degree())
        self._a = tuple(float(a) for a in polynomial.coef)
        self._slope = tuple(float(a) for a in polynomial.deriv().coef)
        self.rises = signs == {1.0}

    def __call__(self, x: float) -> float:
        """Value at x."""
        return _horner(self._a, x)

    def inverse(self, y: float) -> float:
        """Argument whose value is y; the nearest end of the range for a y outside."""
        if len(self._a) == 2:
            return (y - self._a[0]) / self._a[1]
        low, high = self.low, self.high
        x = 0.5 * (low + high)
        for _ in range(TURNS):
            off = _horner(self._a, x) - y
            if off == 0.0:
                break
            if (off > 0.0) == self.rises:
                high = x
            else:
                low = x
            slope = _horner(self._slope, x)
            step = x - off / slope if slope else low
            new = step if low < step < high else 0.5 * (low + high)
            if new == x:
                break
            x = new
        return x

    @property
    def image(self) -> tuple[float, float]:
        """Lowest and highest value over the range."""
        ends = (self(self.low), self(self.high))
        return min(ends), max(ends)


def _horner(a: tuple[float, ...], x: float) -> float:
    value = 0.0
    for coefficient in reversed(a):
        value = value * x + coefficient
    return value


def _between(edges: list[float]) -> list[float]:
    """One point inside each interval."""
    return [0.5 * (a + b) for a, b in pairwise(edges)]
