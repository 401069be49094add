"""Control laws, one file each.

A lab's own is installed in the entry point group ``pea.laws`` (`pea_core.registry`). A law offers
``Params``, ``design``, ``start``, ``output`` and ``update``, see `pea_core.block`. It may declare
what tools need to know of it:

Params.PRESET : str
    Preset that comes with its type.
COMPARED : bool
    Whether ``pea compare`` compares it where nobody names controllers.
NEEDS : dict
    Parameters that must be given with its type.
absorb(c, s, gap)
    The state with which its command is higher by `gap`.
unlearned(params)
    Parameters without what it learns from period to period.
switching(params)
    Steps of its command (V) that switching causes in steady state.
equivalent_pid(params)
    Gains of the PID + D^2 law that it is, in the paper's units, by name with unit.
"""

from pea_controller.model import (
    damped,
    open_loop,
    pid,
    pidsmc,
    pidsmc_modal,
    predictive,
    smc,
    smc_boundary_layer,
    state_feedback,
)
from pea_core.registry import models, registry

MODELS = models(
    "pea.laws",
    {
        "open_loop": open_loop,
        "pid": pid,
        "smc": smc,
        "smc_boundary_layer": smc_boundary_layer,
        "pidsmc": pidsmc,
        "predictive": predictive,
        "damped": damped,
        "state_feedback": state_feedback,
        "pidsmc_modal": pidsmc_modal,
    },
    (
        "design",
        "start",
        "output",
        "update",
    ),
)
CHOICE = registry("pea.laws", MODELS, "pidsmc", "control law", live=True)
