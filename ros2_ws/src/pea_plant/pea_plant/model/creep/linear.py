"""Creep operators given one by one, any number of them.

The four default operators follow logarithmic creep within 0.12 % from 0.05 s to 50 s.
"""

from dataclasses import dataclass

import numpy as np

from pea_core.params import ParameterError, param


@dataclass(frozen=True)
class Params:
    """Creep operators."""

    enabled: bool = param(False, help="whether the actuator creeps", fixed=True)
    tau: tuple[float, ...] = param(
        (0.05, 0.5, 5.0, 50.0), "s", 1e-6, 1e6, help="time constants", fixed=True
    )
    weights: tuple[float, ...] = param(
        (0.015, 0.015, 0.015, 0.015), "", 0.0, 10.0, help="share of each operator", fixed=True
    )

    def __post_init__(self) -> None:
        if len(self.tau) != len(self.weights):
            raise ParameterError(
                f"weights has {len(self.weights)} values and tau {len(self.tau)}: "
                "give one weight for each time constant"
            )


def operators(params: Params) -> tuple[np.ndarray, np.ndarray]:
    """tau (n) in s and weights (n)."""
    return np.array(params.tau), np.array(params.weights)
