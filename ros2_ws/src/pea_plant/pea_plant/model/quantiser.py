"""Uniform quantiser, as in a DAC and in a digital sensor."""

import numpy as np

WHOLE = 4503599627370496.0
"""2^52: from here on every float is a whole number."""


def quantise(x: float, step: float) -> float:
    """The multiple of `step` nearest to x, halves upwards; the error is at most step/2."""
    levels = x / step
    if abs(levels) >= WHOLE:
        return x
    return step * float(np.floor(levels + 0.5))
