"""f_e: external load on the end-effector as a signal, one file a model.

Each offers ``output(c, k)``: volts-equivalent load at sample k, held over the interval that
begins there. It adds to H's output at the input of V, Eq 1, and so passes F_c as well.
"""

from pea_core.block import registry
from pea_plant.model.load import file, none, sine, step

MODELS = {"none": none, "step": step, "sine": sine, "file": file}
CHOICE = registry(MODELS, "none", "external load f_e")
