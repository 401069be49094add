"""Observers, one file each."""

from pea_core.block import registry
from pea_observer.model import (
    alpha_beta,
    discrete_uio,
    discrete_uio_two_step,
    extended_state,
    kalman,
    kalman_rate,
    levant,
    luenberger,
    passthrough,
    pid_sliding_mode,
)

MODELS = {
    "passthrough": passthrough,
    "luenberger": luenberger,
    "extended_state": extended_state,
    "pid_sliding_mode": pid_sliding_mode,
    "kalman": kalman,
    "kalman_rate": kalman_rate,
    "alpha_beta": alpha_beta,
    "levant": levant,
    "discrete_uio": discrete_uio,
    "discrete_uio_two_step": discrete_uio_two_step,
}
CHOICE = registry(MODELS, "extended_state", "observer", live=True)
