"""Drawing without a screen: import `plt` from here, so that every figure shows text as text.

A dollar in a name begins no formula. Text of others goes through `pea_core.printable`.
"""

import io
import re
import warnings
from pathlib import Path
from typing import Any

import matplotlib
import matplotlib.rcsetup
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.rcsetup import cycler
from matplotlib.scale import LogScale, register_scale
from matplotlib.ticker import LogFormatter
from PIL import Image

plt.rcParams["text.parse_math"] = False
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7F7F7F")
"""Colours of Okabe and Ito, which colour-blind readers can tell apart."""

plt.rcParams["axes.prop_cycle"] = cycler(color=COLOURS)
plt.rcParams["svg.fonttype"] = "none"  # text stays text
plt.rcParams["svg.hashsalt"] = "pea"  # the same figure is the same file
plt.rcParams["pdf.fonttype"] = 42

__all__ = ["COLOURS", "FORMATS", "LABEL_MAX", "TITLE_MAX", "plt", "png", "save", "save_as"]


class _Plain(LogFormatter):
    """Numbers at the ticks of a logarithmic axis: formulas are not drawn."""

    def __call__(self, x: float, pos: int | None = None) -> str:
        return f"{x:g}" if super().__call__(x, pos) else ""


class _Log(LogScale):
    """Logarithmic axes of every figure."""

    name = "log"

    def __init__(self, *given: Any, **options: Any) -> None:  # an axis before matplotlib 3.11
        super().__init__(*given, **options)

    def set_default_locators_and_formatters(self, axis: Axis) -> None:
        super().set_default_locators_and_formatters(axis)
        axis.set_major_formatter(_Plain(self.base))
        axis.set_minor_formatter(_Plain(self.base, labelOnlyBase=self.subs is not None))


register_scale(_Log)

FORMATS = (".pdf", ".svg", ".png")
"""Endings of figures for papers."""

TITLE_MAX, LABEL_MAX = 110, 40
"""Characters of a figure's title, and of a run's name in a legend."""


def png(plot: Figure) -> bytes:
    """A figure as PNG of few colours, a third of the size; closes it."""
    small = io.BytesIO()
    canvas: Any = FigureCanvasAgg(plot)
    plot.set_dpi(90)
    with warnings.catch_warnings():  # a letter that no font has is a box
        warnings.filterwarnings("ignore", "Glyph .* missing from font", UserWarning)
        canvas.draw()
    plt.close(plot)
    pixels = Image.fromarray(np.asarray(canvas.buffer_rgba()))
    pixels.convert("RGB").quantize(64).save(small, "PNG", optimize=True)
    return small.getvalue()


def save(plot: Figure, path: Path) -> None:
    """Write a figure as `png`."""
    path.write_bytes(png(plot))


def save_as(plot: Figure, path: Path) -> None:
    """Write a figure as a new file of the kind that its name says; closes it.

    Raises
    ------
    FileExistsError
        It is there already.
    """
    drawn = io.BytesIO()
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph .* missing from font", UserWarning)
        plot.savefig(drawn, format=path.suffix[1:], dpi=200, metadata=_undated(path.suffix))
    plt.close(plot)
    data = drawn.getvalue()
    with open(path, "xb") as file:
        file.write(_PATH.sub(_rounded, data) if path.suffix == ".svg" else data)


_PATH = re.compile(rb' d="[^"]*"')


def _rounded(found: re.Match[bytes]) -> bytes:
    """A path of an SVG to 0.01 pt: half the size."""
    return re.sub(rb"(\.\d\d)\d+", rb"\1", found[0])


def _undated(suffix: str) -> dict[str, None]:
    """Without the date, the same figure is the same file."""
    return {".pdf": {"CreationDate": None}, ".svg": {"Date": None}}.get(suffix, {})
