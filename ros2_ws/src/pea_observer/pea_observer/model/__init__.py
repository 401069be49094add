"""Observers, one file each."""

from pea_core.block import registry
from pea_observer.model import extended_state, luenberger, passthrough

MODELS = {
    "passthrough": passthrough,
    "luenberger": luenberger,
    "extended_state": extended_state,
}
CHOICE = registry(MODELS, "extended_state", "observer")
