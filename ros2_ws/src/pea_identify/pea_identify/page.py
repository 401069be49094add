"""The page of an identified stage: figures with residuals, numbers, what is not determined.

The only module here that draws; matplotlib is imported when a page is made.
"""

from __future__ import annotations

import base64
import html
import io
import math
from pathlib import Path
from typing import Any

import numpy as np

from pea_core.units import NM_PER_M
from pea_identify.identified_stage import IdentifiedStage
from pea_identify.results import numbers

STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 64rem; margin: 2rem auto; padding: 0 1rem; }
table { border-collapse: collapse; margin: 1rem 0; font-variant-numeric: tabular-nums; }
th, td { border-bottom: 1px solid #d5d8de; padding: .2rem .8rem .2rem 0; text-align: left; }
img { max-width: 100%; }
"""

POINTS = 4000
"""Points of a curve that are drawn."""


def write(stage: IdentifiedStage, there: Path, title: str) -> Path:
    """Write the page, figures inside; return its path."""
    figures = [drawn(make, stage) for make in (response, hysteresis, creep, residuals)]
    pictures = "\n".join(
        f'<img alt="{name}" src="data:image/png;base64,{base64.b64encode(data).decode()}">'
        for name, data in figures
        if data
    )
    text = (
        '<!doctype html><html lang="en"><meta charset="utf-8">'
        f"<title>{html.escape(title)}</title><style>{STYLE}</style>"
        f"<h1>{html.escape(title)}</h1>{tables(stage)}{pictures}</html>\n"
    )
    there.write_text(text)
    return there


def drawn(make: Any, stage: IdentifiedStage) -> tuple[str, bytes]:
    """One figure as PNG; empty where the stage has nothing to show there."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 6.0), layout="constrained")
    if not make(figure, stage):
        return make.__name__, b""
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=110)
    return make.__name__, data.getvalue()


def response(figure: Any, stage: IdentifiedStage) -> bool:
    """Measured response, fitted V, residual beside the standard deviation of the data."""
    if stage.response is None or stage.modes is None:
        return False
    r, fitted = stage.response, stage.modes(stage.response.f)[:, 0, 0]
    if stage.through_H:
        fitted = fitted * stage.small / stage.modes.gain[0, 0]
    G = r.G[:, 0, 0]
    top, bottom = figure.subplots(2, 1, sharex=True)
    top.loglog(r.f, np.abs(G) * 1e6, ".", ms=2, label="measured")
    top.loglog(r.f, np.abs(fitted) * 1e6, lw=1, label="V")
    top.loglog(r.f, np.abs(fitted - G) * 1e6, lw=0.6, label="residual")
    sigma = np.sqrt(r.variance[:, 0, 0])
    if np.isfinite(sigma).any():
        top.loglog(r.f, sigma * 1e6, lw=0.6, label="standard deviation of the data")
    top.set_ylabel("µm/V")
    top.legend()
    bottom.semilogx(r.f, np.degrees(np.unwrap(np.angle(G))), ".", ms=2)
    bottom.semilogx(r.f, np.degrees(np.unwrap(np.angle(fitted))), lw=1)
    bottom.set_ylabel("phase in degrees")
    bottom.set_xlabel("Hz")
    figure.suptitle("Frequency response")
    return True


def hysteresis(figure: Any, stage: IdentifiedStage) -> bool:
    """Loops measured and modelled, and what is left."""
    slow = [r for r in stage.records if r.kind == "slow"]
    if not slow or stage.hysteresis is None:
        return False
    r = slow[0]
    model = stage.simulate(r.u[:, 0], r.T_s)
    every = max(1, len(r.u) // POINTS)
    left, right = figure.subplots(1, 2)
    left.plot(r.u[::every, 0], r.y[::every, 0] * 1e6, lw=0.8, label="measured")
    left.plot(r.u[::every, 0], model[::every] * 1e6, lw=0.8, label=stage.hysteresis.type)
    left.set_xlabel("V")
    left.set_ylabel("µm")
    left.legend()
    t = np.arange(len(model))[::every] * r.T_s
    right.plot(t, (model - r.y[:, 0])[::every] * NM_PER_M, lw=0.6)
    right.set_xlabel("s; the last third was not fitted when the model was chosen")
    right.set_ylabel("residual in nm")
    figure.suptitle("Hysteresis")
    return True


def creep(figure: Any, stage: IdentifiedStage) -> bool:
    """The hold after a step, modelled, and what is left."""
    if stage.creep is None:
        return False
    c = stage.creep
    top, bottom = figure.subplots(2, 1, sharex=True)
    top.semilogx(c.t, c.y * 1e6, ".", label="measured")
    top.semilogx(c.t, c.model * 1e6, label="model")
    top.set_ylabel("µm")
    top.legend()
    bottom.semilogx(c.t, (c.model - c.y) * NM_PER_M, ".-")
    bottom.set_ylabel("residual in nm")
    bottom.set_xlabel("s after the step")
    figure.suptitle("Creep")
    return True


def residuals(figure: Any, stage: IdentifiedStage) -> bool:
    """The whole model beside each moving record."""
    moving = [r for r in stage.records if r.kind != "rest"][:6]
    if not moving or math.isnan(stage.gain):
        return False
    axes = np.atleast_1d(figure.subplots(len(moving), 1, squeeze=False)[:, 0])
    for axis, r in zip(axes, moving, strict=True):
        y = r.y[:, 0]
        model = stage.simulate(r.u[:, 0], r.T_s)
        every = max(1, len(y) // POINTS)
        t = np.arange(len(y))[::every] * r.T_s
        error = model - y
        axis.plot(t, (error - error.mean())[::every] * NM_PER_M, lw=0.5)
        axis.set_ylabel("nm", fontsize=8)
        axis.set_title(f"{r.name} ({r.kind}): model less measured", fontsize=8)
    axes[-1].set_xlabel("s")
    return True


def cell(value: object) -> str:
    """A number with its interval, or any other value."""
    if isinstance(value, dict) and "low_95" in value:
        half = (value["high_95"] - value["low_95"]) / 2.0
        return f"{value['value']:.6g} ± {half:.2g}"
    if isinstance(value, float):
        return f"{value:.6g}"
    return html.escape(str(value))


def tables(stage: IdentifiedStage) -> str:
    """Numbers, with intervals of 95 %."""
    told = numbers(stage)
    parts = ["<p>± is the half width of the 95 % interval.</p>"]
    if told["not_determined"]:
        rows = "".join(f"<li>{html.escape(s)}</li>" for s in told["not_determined"])
        parts.append(f"<h2>What the data do not determine</h2><ul>{rows}</ul>")
    single: dict[str, Any] = {
        k: v for k, v in told.items() if isinstance(v, dict) and "low_95" in v
    }
    for name in ("hysteresis", "creep", "noise", "response"):
        for key, value in told.get(name, {}).items():
            if isinstance(value, (float, int, str)) or (
                isinstance(value, dict) and "low_95" in value
            ):
                single[f"{name}: {key}"] = value
    rows = "".join(f"<tr><td>{k}</td><td>{cell(v)}</td></tr>" for k, v in single.items())
    parts.append(f"<h2>Numbers</h2><table>{rows}</table>")
    for title, rows_of in (
        ("Modes", told.get("modes", [])),
        ("Models of H compared", told.get("hysteresis", {}).get("compared", [])),
        ("Records", told["records"]),
    ):
        if rows_of:
            names = list(rows_of[0])
            head = "".join(f"<th>{n}</th>" for n in names)
            body = "".join(
                "<tr>" + "".join(f"<td>{cell(row.get(n, ''))}</td>" for n in names) + "</tr>"
                for row in rows_of
            )
            parts.append(f"<h2>{title}</h2><table><tr>{head}</tr>{body}</table>")
    amplitudes = told.get("amplitudes", [])
    if len(amplitudes) > 1:
        rows = "".join(
            f"<tr><td>{a['rms_V']:.4g}</td><td>{cell(a['gain_um_per_V'])}</td><td>"
            + ", ".join(f"{m['frequency_hz']['value']:.6g}" for m in a["modes"])
            + "</td></tr>"
            for a in amplitudes
        )
        head = "<tr><th>rms V</th><th>gain um/V</th><th>modes Hz</th></tr>"
        parts.append(f"<h2>At each amplitude</h2><table>{head}{rows}</table>")
    return "".join(parts)
