"""What every vibration model has besides: a transport delay, whole samples and a fraction."""

from dataclasses import dataclass

from pea_core.params import param


@dataclass(frozen=True)
class Delayed:
    """Transport delay from effective voltage to displacement, V(s) exp(-s delay)."""

    delay: float = param(0.0, "s", 0.0, 0.01, help="transport delay of V", fixed=True)
