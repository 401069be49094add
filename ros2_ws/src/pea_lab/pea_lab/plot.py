"""Drawing without a screen: import `plt` from here, so that every figure shows text as text.

A dollar in a name begins no formula. Text of others goes through `pea_core.printable`.
"""

import io
import warnings
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.figure import Figure
from PIL import Image

plt.rcParams["text.parse_math"] = False

__all__ = ["LABEL_MAX", "TITLE_MAX", "plt", "png", "save"]

TITLE_MAX, LABEL_MAX = 110, 40
"""Characters of a figure's title, and of a run's name in a legend."""


def png(plot: Figure) -> bytes:
    """A figure as PNG of few colours, a third of the size; closes it."""
    pixels, small = io.BytesIO(), io.BytesIO()
    with warnings.catch_warnings():  # a letter that no font has is a box
        warnings.filterwarnings("ignore", "Glyph .* missing from font", UserWarning)
        plot.savefig(pixels, dpi=90)
    plt.close(plot)
    Image.open(pixels).convert("RGB").quantize(64).save(small, "PNG", optimize=True)
    return small.getvalue()


def save(plot: Figure, path: Path) -> None:
    """Write a figure as `png`."""
    path.write_bytes(png(plot))
