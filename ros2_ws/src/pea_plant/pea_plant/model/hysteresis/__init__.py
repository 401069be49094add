"""H: rate-independent hysteresis from input voltage to effective voltage, one file a model."""

from pea_core.block import registry
from pea_plant.model.hysteresis import bouc_wen, none, prandtl_ishlinskii, preisach

MODELS = {
    "none": none,
    "bouc_wen": bouc_wen,
    "prandtl_ishlinskii": prandtl_ishlinskii,
    "preisach": preisach,
}
CHOICE = registry(MODELS, "none", "hysteresis model H")
