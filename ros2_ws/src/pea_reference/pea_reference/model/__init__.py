"""Reference signals, one file each."""

from pea_core.block import registry
from pea_reference.model import constant, sine, step

MODELS = {
    "constant": constant,
    "step": step,
    "sine": sine,
}
CHOICE = registry(MODELS, "sine", "desired displacement")
