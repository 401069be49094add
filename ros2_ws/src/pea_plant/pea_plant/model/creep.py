r"""F_c: linear creep as a sum of first-order operators.

.. math:: F_c(s) = 1 + \sum_i \frac{w_i}{\tau_i s + 1}

F_c and V are linear, so F_c may stand in front of V without changing y (Section II).
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


def continuous(params: Params) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A (n, n), B (n, 1) and C (1, n) of the creeping part; n = 0 where creep is off."""
    tau = np.array(params.tau if params.enabled else ())
    weights = np.array(params.weights if params.enabled else ())
    return np.diag(-1.0 / tau), (weights / tau)[:, None], np.ones((1, tau.size))
