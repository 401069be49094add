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
FILE, table(values) or text(values), understood(params)
    Parameter that names a file; its contents, which go with a recording, as a table with a heading
    or as text; one line on how it was read.
scan(params)
    Parameters that must be the same for all axes, where it is one axis of a scan.
events(params, T_s, first, last)
    Frames, lines, pixels and points that begin at samples first to last - 1 (`scan.EVENT`).
bounds(params)
    Largest velocity, acceleration and jerk (SI).
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from pea_core.registry import models, registry
from pea_reference.model import (
    chirp,
    constant,
    file,
    levels,
    lissajous,
    multisine,
    points,
    raster,
    sine,
    sine_series,
    spiral,
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
        "raster": raster,
        "spiral": spiral,
        "lissajous": lissajous,
        "points": points,
    },
    (
        "design",
        "output",
    ),
)
CHOICE = registry("pea.references", MODELS, "sine", "desired displacement")


def events_of(params: Any, T_s: float) -> Callable[[int, int], np.ndarray] | None:
    """Events of a scan that begin at samples first to last - 1; None where it is none."""
    events = getattr(MODELS[CHOICE.type_of(params)], "events", None)
    return None if events is None else partial(events, params, T_s)
