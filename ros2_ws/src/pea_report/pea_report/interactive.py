"""Signals of runs to zoom into: a plot for a page that needs nothing else.

The library of the plot is in the page. A curve has at most `figures.LINE` points, which hold the
minimum and maximum of each piece: no spike disappears.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from typing import Any

from pea_core.printable import printable
from pea_lab.plot import COLOURS, LABEL_MAX
from pea_report.figures import Run, line

ROWS = ("displacement (µm)", "error x1 - w (nm)", "voltage (V)", "eps (V)")
"""Plots below each other; they share the axis of time."""

GREY = "#808080"
"""Ink that can be read on a light page and on a dark one."""

CONFIG = {"displaylogo": False, "responsive": True, "plotlyServerURL": ""}


def _curves(run: Run) -> list[tuple[int, str, str, Any]]:
    """Row, name, dash and points of each curve."""
    found: list[tuple[int, str, str, Any]] = [
        (1, "y", "solid", line(run, run.signal("y", 1e6))),
        (1, "w", "dash", line(run, run.signal("w", 1e6))),
        (2, "error", "solid", line(run, run.error)),
        (3, "u", "solid", line(run, run.signal("u"))),
        (3, "u applied", "dash", line(run, run.signal("u_applied"))),
        (4, "eps_hat", "solid", line(run, run.signal("eps_hat"))),
    ]
    if run.true is not None:
        true = run.true["eps"]
        found.append((4, "eps", "dash", line(run, lambda part: true[part])))
    return found


def figure(runs: Sequence[Run]) -> Any:
    """The runs over each other, each in colours of its own; legend below the plots."""
    import plotly.graph_objects as graph
    from plotly.subplots import make_subplots

    plot = make_subplots(rows=len(ROWS), cols=1, shared_xaxes=True, vertical_spacing=0.03)
    number = 0
    for run in runs:
        for row, name, dash, (t, x) in _curves(run):
            label = name if len(runs) == 1 else f"{printable(run.name, LABEL_MAX)}: {name}"
            colour = COLOURS[number % len(COLOURS)]
            ink = {"color": colour, "dash": dash, "width": 1.2}
            plot.add_trace(graph.Scatter(x=t, y=x, name=label, line=ink), row=row, col=1)
            number += 1
    for row, title in enumerate(ROWS, start=1):
        plot.update_yaxes(title_text=title, row=row, col=1)
    plot.update_xaxes(title_text="time (s)", row=len(ROWS), col=1)
    return styled(plot, 240 * len(ROWS))


def styled(plot: Any, height: int) -> Any:
    """A plot of a height (px) that can be read on a light page and on a dark one."""
    axes = {"gridcolor": "rgba(128,128,128,0.3)", "zeroline": False}
    plot.update_xaxes(**axes)
    plot.update_yaxes(**axes)
    plot.update_layout(
        height=height,
        margin={"l": 60, "r": 10, "t": 20, "b": 60},
        legend={"orientation": "h", "y": -0.08},
        hovermode="x unified",
        paper_bgcolor="rgba(0,0,0,0)",
        plot_bgcolor="rgba(0,0,0,0)",
        font={"color": GREY},
    )
    return plot


def part_of_page(runs: Sequence[Run]) -> str:
    """The plot of the runs and its library, as a part of a page."""
    return embedded(figure(runs), "signals")


def embedded(plot: Any, name: str) -> str:
    """A plot and its library, as a part of a page; `name` is the element's."""
    from plotly.io import to_html
    from plotly.offline import get_plotlyjs

    library = base64.b64encode(get_plotlyjs().encode()).decode()
    body = to_html(plot, CONFIG, include_plotlyjs=False, full_html=False, div_id=name)
    return f'<script src="data:text/javascript;base64,{library}"></script>\n{body}\n'
