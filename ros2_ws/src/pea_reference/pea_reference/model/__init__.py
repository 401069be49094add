"""Reference signals, one file each.

A lab's own is installed in the entry point group ``pea.references`` (`pea_core.registry`). A
reference offers ``Params``, ``design`` and ``output(c, k)``, see `pea_core.block.Signal`. It may
declare what tools need to know of it:

segments(params)
    Parts that repeat themselves: begin, end and period (s) of each.
move(params)
    Time (s) and level (m) of its last change of level.
lines(params)
    Frequencies (Hz) of a periodic excitation by which a response is measured.
FILE, table(values), understood(params)
    Parameter that names a file; its contents as a table with a heading, which go with a recording;
    one line on how it was read.
"""

from pea_core.registry import models, registry
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

MODELS = models(
    "pea.references",
    {
        "constant": constant,
        "step": step,
        "sine": sine,
        "sine_series": sine_series,
        "multisine": multisine,
        "chirp": chirp,
        "triangle": triangle,
        "levels": levels,
        "file": file,
    },
    (
        "design",
        "output",
    ),
)
CHOICE = registry(MODELS, "sine", "desired displacement")
