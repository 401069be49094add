"""H: rate-independent hysteresis from input voltage to effective voltage, one file a model.

A lab's own is installed in the entry point group ``pea.hysteresis`` (`pea_core.registry`). A model
offers ``Params``, ``design``, ``start``, ``output`` and ``update``, see `pea_core.block`, for
every ``Params()`` by default. `ABSENT` says of one that there is no hysteresis with it.
"""

from pea_core.registry import models, registry
from pea_plant.model.hysteresis import (
    bouc_wen,
    modified_prandtl_ishlinskii,
    none,
    prandtl_ishlinskii,
    preisach,
)

MODELS = models(
    "pea.hysteresis",
    {
        "none": none,
        "bouc_wen": bouc_wen,
        "prandtl_ishlinskii": prandtl_ishlinskii,
        "modified_prandtl_ishlinskii": modified_prandtl_ishlinskii,
        "preisach": preisach,
    },
    (
        "design",
        "start",
        "output",
        "update",
    ),
)
CHOICE = registry("pea.hysteresis", MODELS, "none", "hysteresis model H")

PRESENT = tuple(name for name, model in MODELS.items() if not getattr(model, "ABSENT", False))
"""Types with which there is hysteresis."""
