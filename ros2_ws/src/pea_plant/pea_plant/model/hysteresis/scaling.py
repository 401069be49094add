"""Scaling of a hysteresis model through one measured point."""

from pea_core.params import ParameterError

STEEPEST = 1000.0
"""Largest slope dv/du: H is about unity gain, and beyond this numbers may overflow."""


def scale(first_rise: float, steepest: float, v_max: float) -> float:
    """Factor that makes the first rise from rest reach v_max (V).

    Parameters
    ----------
    first_rise : float
        Unscaled v (V) at the scaling point, positive.
    steepest : float
        Largest unscaled slope dv/du.
    v_max : float
        v (V) there once scaled.

    Raises
    ------
    ParameterError
        The scaled slope would exceed `STEEPEST`.
    """
    if steepest * v_max > STEEPEST * first_rise:
        raise ParameterError(
            f"v_max = {v_max:g}: gives H a slope above {STEEPEST:g}; "
            "lower it or move the scaling point u_max"
        )
    return v_max / first_rise
