"""What stands between any controller and any driver."""

import math

from pea_core.loop import LoopFault


class UnsafeCommand(LoopFault):
    """A command that no driver may see; the text names it."""


def limit(u: float, voltage_min: float, voltage_max: float) -> float:
    """Hold a finite command u (V) within the amplifier's range (V)."""
    return min(max(u, voltage_min), voltage_max)


def check(u: float, k: int) -> None:
    """Refuse a command that is no finite number.

    Raises
    ------
    UnsafeCommand
        u (V) at sample k is NaN or infinite.
    """
    if not math.isfinite(u):
        raise UnsafeCommand(f"voltage at sample {k} is {u}: a command must be a finite number")
