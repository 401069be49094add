"""Reference signals, one file each."""

from pea_core.block import registry
from pea_reference.model import (
    chirp,
    constant,
    file,
    levels,
    multisine,
    sine,
    sine_series,
    step,
    triangle,
)

MODELS = {
    "constant": constant,
    "step": step,
    "sine": sine,
    "sine_series": sine_series,
    "multisine": multisine,
    "chirp": chirp,
    "triangle": triangle,
    "levels": levels,
    "file": file,
}
CHOICE = registry(MODELS, "sine", "desired displacement")
