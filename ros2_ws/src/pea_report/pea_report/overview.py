"""Pages to zoom into, which need nothing else: a comparison of loops, a tuning's candidates."""

from __future__ import annotations

import html
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pea_core.printable import printable
from pea_lab.plot import COLOURS, LABEL_MAX
from pea_lab.tune import Goal, Trial, best, margin_text
from pea_report.interactive import embedded, styled

HEAD = """<!doctype html>
<html lang="en"><head><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>
:root {{ color-scheme: light dark; }}
body {{ font: 15px system-ui, sans-serif; max-width: 1200px; margin: 1em auto; padding: 0 1em; }}
</style></head><body><h1>{title}</h1>
<p>{text}</p>
"""


def _write(path: Path, title: str, text: str, plot: Any) -> None:
    head = HEAD.format(title=html.escape(title), text=html.escape(text))
    body = embedded(plot, path.stem)
    path.write_text(f"{head}{body}</body></html>\n", encoding="utf-8")


def compared(path: Path, name: str, rows: Sequence[dict[str, Any]], duration: float) -> None:
    """Write the error of every combination over time, one panel for each plant.

    Parameters
    ----------
    path : Path
        New file.
    name, rows, duration
        As of `pea_lab.compare.write`.
    """
    import plotly.graph_objects as graph
    from plotly.subplots import make_subplots

    ran = [row for row in rows if "curve_nm" in row]
    plants = list(dict.fromkeys(row["plant"] for row in ran)) or [""]
    loops = list(dict.fromkeys((row["controller"], row["observer"]) for row in ran))
    plot = make_subplots(
        rows=len(plants),
        cols=1,
        shared_xaxes=True,
        shared_yaxes=True,
        vertical_spacing=0.1,
        subplot_titles=[f"plant: {printable(str(plant), LABEL_MAX)}" for plant in plants],
    )
    named: set[tuple[str, str]] = set()
    for row in ran:
        loop = (row["controller"], row["observer"])
        text = printable(", ".join(loop), LABEL_MAX)
        t = (np.arange(len(row["curve_nm"])) + 0.5) / len(row["curve_nm"]) * duration
        plot.add_trace(
            graph.Scatter(
                x=t,
                y=np.maximum(row["curve_nm"], 1e-3),
                name=text,
                legendgroup=text,
                showlegend=loop not in named,
                hovertemplate=f"%{{y:.3g}} nm; {row['rms_error_nm']:.3g} nm where it is scored",
                line={"color": COLOURS[loops.index(loop) % len(COLOURS)], "width": 1.2},
            ),
            row=1 + plants.index(row["plant"]),
            col=1,
        )
        named.add(loop)
    plot.update_yaxes(type="log", title_text="rms error (nm)")
    plot.update_xaxes(title_text="time (s)", row=len(plants), col=1)
    text = f"{len(rows)} loops; each curve is the rms error of a piece of the run."
    _write(path, f"{name}: tracking error", text, styled(plot, 360 * len(plants)))


def tuned(path: Path, name: str, goal: Goal, trials: Sequence[Trial]) -> None:
    """Write what was traded: error against margin, and against the steps of the voltage.

    Parameters
    ----------
    path : Path
        New file.
    name : str
        Name of the experiment.
    goal, trials
        As of `pea_lab.tune_results.write`.
    """
    import plotly.graph_objects as graph
    from plotly.subplots import make_subplots

    ran = [trial for trial in trials if math.isfinite(trial.error_nm)]
    groups: tuple[tuple[str, str, list[Trial]], ...] = (
        ("keeps the margin", "circle", [trial for trial in ran if trial.good]),
        ("does not", "x", [trial for trial in ran if not trial.good]),
        ("best", "star", [trial for trial in [best(trials)] if trial in ran]),
        ("before", "square", [trial for trial in trials[:1] if trial in ran]),
    )
    plot = make_subplots(rows=1, cols=2, shared_yaxes=True)
    for number, (label, symbol, group) in enumerate(groups):
        size = 7 if number < 2 else 14
        for column, axis in enumerate(("margin", "step_V"), start=1):
            plot.add_trace(
                graph.Scatter(
                    x=[getattr(trial, axis) for trial in group],
                    y=[trial.error_nm for trial in group],
                    name=label,
                    mode="markers",
                    legendgroup=label,
                    showlegend=column == 1,
                    marker={"color": COLOURS[number], "symbol": symbol, "size": size},
                    hovertext=[_gains(trial) for trial in group],
                ),
                row=1,
                col=column,
            )
    plot.add_vline(goal.margin, line={"dash": "dot"}, row=1, col=1)
    plot.update_yaxes(type="log", title_text="error (nm, rms over the plants)", row=1, col=1)
    plot.update_yaxes(type="log", row=1, col=2)
    plot.update_xaxes(title_text="gain margin", row=1, col=1)
    plot.update_xaxes(type="log", title_text="rms step of the voltage (V)", row=1, col=2)
    text = f"{len(trials)} candidates over {len(goal.plants)} plants. Point at one for its gains."
    plot = styled(plot, 520).update_layout(hovermode="closest", legend_y=-0.2)
    _write(path, f"{name}: candidates", text, plot)


def _gains(trial: Trial) -> str:
    gains = [f"{name} {value:.4g}" for name, value in trial.values.items()]
    return "<br>".join([*gains, f"gain margin {margin_text(trial.margin)}"])
