"""Observers, one file each.

A lab's own is installed in the entry point group ``pea.observers`` (`pea_core.registry`). An
observer offers ``Params``, ``design``, ``start``, ``output`` and ``update``, see `pea_core.block`.
It may declare what tools need to know of it:

Params.PRESET : str
    Preset that comes with its type.
NEEDS_VELOCITY : bool
    It needs the true velocity, which only an ideal sensor measures.
KNOWS_EPS : bool
    False where its eps is always 0.
"""

from pea_core.registry import models, registry
from pea_observer.model import (
    alpha_beta,
    discrete_uio,
    discrete_uio_two_step,
    extended_state,
    extended_state_modal,
    kalman,
    kalman_modal,
    kalman_rate,
    levant,
    luenberger,
    measured,
    passthrough,
    pid_sliding_mode,
)

MODELS = models(
    "pea.observers",
    {
        "passthrough": passthrough,
        "measured": measured,
        "luenberger": luenberger,
        "extended_state": extended_state,
        "pid_sliding_mode": pid_sliding_mode,
        "kalman": kalman,
        "kalman_rate": kalman_rate,
        "kalman_modal": kalman_modal,
        "extended_state_modal": extended_state_modal,
        "alpha_beta": alpha_beta,
        "levant": levant,
        "discrete_uio": discrete_uio,
        "discrete_uio_two_step": discrete_uio_two_step,
    },
    (
        "design",
        "start",
        "output",
        "update",
    ),
)
CHOICE = registry("pea.observers", MODELS, "extended_state", "observer", live=True)
