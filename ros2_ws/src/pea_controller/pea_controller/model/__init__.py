"""Control laws, one file each."""

from pea_controller.model import pid, pidsmc
from pea_core.block import registry

MODELS = {
    "pid": pid,
    "pidsmc": pidsmc,
}
CHOICE = registry(MODELS, "pidsmc", "control law")
