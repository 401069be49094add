r"""F_c: linear creep as a sum of first-order operators, one file a way to state them.

.. math:: F_c(s) = 1 + \sum_i \frac{w_i}{\tau_i s + 1}

F_c and V are linear, so F_c may stand in front of V without changing y (Section II).
Each file offers ``operators(params)``: time constants tau_i (n) in s and weights w_i (n).

A lab's own is installed in the entry point group ``pea.creep`` (`pea_core.registry`); its
``Params`` have a field ``enabled``.
"""

from typing import Any

import numpy as np

from pea_core.registry import models, registry
from pea_plant.model.creep import linear, log

MODELS = models(
    "pea.creep",
    {"linear": linear, "log": log},
    ("operators",),
)
CHOICE = registry("pea.creep", MODELS, "linear", "how the creep F_c is stated")


def continuous(params: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A (n, n), B (n, 1) and C (1, n) of the creeping part; n = 0 where creep is off."""
    tau, weights = np.array([]), np.array([])
    if params.enabled:
        tau, weights = MODELS[CHOICE.type_of(params)].operators(params)
    return np.diag(-1.0 / tau), (weights / tau)[:, None], np.ones((1, tau.size))
