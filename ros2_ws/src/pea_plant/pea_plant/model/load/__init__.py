"""f_e: external load on the end-effector as a signal, one file a model.

Each offers ``output(c, k)``: volts-equivalent load at sample k, held over the interval that
begins there. It adds to H's output at the input of V, Eq 1, and so passes F_c as well.

A lab's own is installed in the entry point group ``pea.loads`` (`pea_core.registry`) and offers
``Params``, ``design(params, T_s, K)`` and ``output``. It may declare ``FILE``, ``table`` and
``understood`` as a reference does.
"""

from pea_core.registry import models, registry
from pea_plant.model.load import file, none, sine, step

MODELS = models(
    "pea.loads",
    {"none": none, "step": step, "sine": sine, "file": file},
    (
        "design",
        "output",
    ),
)
CHOICE = registry("pea.loads", MODELS, "none", "external load f_e")
