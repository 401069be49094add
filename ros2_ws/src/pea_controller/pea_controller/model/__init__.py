"""Control laws, one file each."""

from pea_controller.model import open_loop, pid, pidsmc, predictive, smc, smc_boundary_layer
from pea_core.block import registry

MODELS = {
    "open_loop": open_loop,
    "pid": pid,
    "smc": smc,
    "smc_boundary_layer": smc_boundary_layer,
    "pidsmc": pidsmc,
    "predictive": predictive,
}
CHOICE = registry(MODELS, "pidsmc", "control law", live=True)
