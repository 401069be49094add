"""V: linear vibration dynamics from effective voltage to displacement, one file a model.

Each offers ``continuous(nominal, params)``, A (n, n), B (n, 1) and C (1, n) from effective
voltage (V) to displacement (m), and ``initial(params, x1, x2)``, the states (n) that have this
displacement (m) and velocity (m/s). `nominal` holds the plant's own zeta, omega_n and K. All have
the transport delay of `late.Delayed`, which the actuator steps.

A lab's own is installed in the entry point group ``pea.vibration`` (`pea_core.registry`); its
``Params`` extend `late.Delayed`.
"""

from pea_core.registry import models, registry
from pea_plant.model.vibration import modal, second_order

MODELS = models(
    "pea.vibration",
    {"second_order": second_order, "modal": modal},
    (
        "continuous",
        "initial",
    ),
)
CHOICE = registry("pea.vibration", MODELS, "second_order", "vibration model V")
