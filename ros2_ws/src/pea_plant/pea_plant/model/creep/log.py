r"""Creep operators fitted to logarithmic creep over stated decades.

.. math:: y(t) = y(t_0)\,(1 + rate \cdot \log_{10}(t / t_0)), \quad t_0 \le t \le 10^{decades} t_0

after a voltage step. Logarithmic creep itself is no causal operator: before t_0 it has no
limit, so the operators are fitted from `first` on, relative to the displacement there. Time
constants lie evenly on the logarithmic axis; the weights and y(t_0) are the least squares of
the relative error. Its maximum is 2.2 % of the rate with one operator a decade, 0.65 % with
two: 0.031 % and 0.009 % of the displacement at the default rate. After the last decade the
creep ends.
"""

from dataclasses import dataclass

import numpy as np

from pea_core.params import param


@dataclass(frozen=True)
class Params:
    """Logarithmic creep."""

    enabled: bool = param(False, help="whether the actuator creeps", fixed=True)
    rate: float = param(0.015, "1/decade", 0.0, 0.3, help="growth a decade", fixed=True)
    first: float = param(0.05, "s", 1e-4, 1e3, help="t_0, where the fit begins", fixed=True)
    decades: int = param(3, "", 1, 8, help="decades of the fit", fixed=True)
    per_decade: int = param(1, "", 1, 2, help="operators a decade", fixed=True)


def operators(params: Params) -> tuple[np.ndarray, np.ndarray]:
    """tau (n) in s and weights (n), fitted; n = decades * per_decade + 1."""
    n = params.decades * params.per_decade + 1
    tau = params.first * 10.0 ** (np.arange(n) / params.per_decade)
    t = np.geomspace(tau[0], tau[-1], 100 * params.decades + 1)
    L = 1.0 + params.rate * np.log10(t / params.first)
    grown = 1.0 - np.exp(-t[:, None] / tau)
    # 1 + grown w = y(t_0) L, every row divided by L
    rows = np.hstack([grown / L[:, None], -np.ones((t.size, 1))])
    solution = np.linalg.lstsq(rows, -1.0 / L, rcond=None)[0]
    return tau, solution[:-1]
