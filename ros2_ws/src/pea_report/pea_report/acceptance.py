"""The page of an acceptance: HTML that needs nothing else, PDF, and the numbers as JSON."""

from __future__ import annotations

import base64
import datetime
import html
import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from PIL import Image

from pea_core.printable import printable
from pea_experiment.metrics import unit
from pea_lab.plot import plt
from pea_measure.acceptance import RULES, SENSOR
from pea_report.report import STYLE

NAMES = {"stroke_um": "um", "creep_percent_per_decade": "% a decade", "drift_nm_per_s": "nm/s"}
"""Units that the end of a name does not say."""

ENDS = ("_percent_per_decade", "_nm_per_s", "_percent", "_um", "_nm", "_hz", "_ms")
"""Ends of names that say the unit."""

PICTURE = "measurement.png"

PANELS = ("hysteresis", "repeatability", "increments", "loop", "steps", "noise")
"""Measurements whose figures are on the PDF page."""


def rows(figures: Mapping[str, object]) -> list[tuple[str, str, str, str]]:
    """Name, value, unit and meaning of each figure."""
    told = []
    for name, rule in RULES.items():
        value = figures.get(name)
        shown = "not measured" if value is None else f"{value:.4g}"
        plain = next((name[: -len(end)] for end in ENDS if name.endswith(end)), name)
        told.append((plain.replace("_", " "), shown, NAMES.get(name, unit(name)), rule))
    return told


def write(
    there: Path, title: str, figures: Mapping[str, object], found: Mapping[str, dict[str, object]]
) -> None:
    """Write ``acceptance.json``, ``acceptance.html`` and ``acceptance.pdf``, each new.

    Parameters
    ----------
    there : Path
        Directory of the acceptance; runs are linked relative to it.
    title : str
    figures : mapping
        `pea_measure.acceptance.summary`.
    found : mapping of str to dict
        Figures of each measurement, with its ``run``.
    """
    runs = {name: str(each["run"]) for name, each in found.items()}
    record = {
        "title": title,
        "reference_sensor": SENSOR,
        "rules": RULES,
        "figures": dict(figures),
        "runs": runs,
        "positions": found.get("repeatability", {}).get("positions"),
        "increments": found.get("increments", {}).get("increments"),
        "margins": found.get("loop", {}).get("margins"),
    }
    (there / "acceptance.json").write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    (there / "acceptance.html").write_text(_html(there, title, figures, runs), encoding="utf-8")
    _pdf(there / "acceptance.pdf", there, title, figures, runs)


def _html(there: Path, title: str, figures: Mapping[str, object], runs: Mapping[str, str]) -> str:
    def text(value: str) -> str:
        return html.escape(printable(value))

    when = datetime.datetime.now(datetime.UTC).isoformat(sep=" ", timespec="minutes")
    cells = "".join(
        "<tr>" + "".join(f"<td>{text(cell)}</td>" for cell in row) + "</tr>\n"
        for row in rows(figures)
    )
    pictures = ""
    for name, run in runs.items():
        link = html.escape(_relative(there, run))
        pictures += f'<h2>{text(name)}</h2>\n<p class=about>run: <a href="{link}">{link}</a></p>\n'
        file = _path(there, run) / PICTURE
        if file.is_file():
            data = base64.b64encode(file.read_bytes()).decode()
            pictures += f'<img alt="{text(name)}" src="data:image/png;base64,{data}">\n'
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">\n'
        f"<title>{text(title)}</title>\n<style>{STYLE}</style></head>\n<body>\n"
        f"<h1>{text(title)}</h1>\n<p class=about>pea accept, {when}</p>\n"
        f"<p>{text(SENSOR)}</p>\n"
        "<div class=wide><table>\n<tr><th></th><th>value</th><th></th><th>meaning</th></tr>\n"
        f"{cells}</table></div>\n{pictures}</body></html>\n"
    )


def _path(there: Path, run: str) -> Path:
    path = Path(run)
    return path if path.is_absolute() or path.exists() else there / path.name


def _relative(there: Path, run: str) -> str:
    path = Path(run)
    return path.name if (there / path.name).is_dir() else str(path)


def _pdf(
    path: Path, there: Path, title: str, figures: Mapping[str, object], runs: Mapping[str, str]
) -> None:
    page = plt.figure(figsize=(8.27, 11.69))
    page.text(0.06, 0.965, printable(title, 90), fontsize=13, weight="bold")
    page.text(0.06, 0.95, SENSOR, fontsize=6.5, wrap=True, va="top")
    for i, row in enumerate(rows(figures)):
        y = 0.915 - 0.0155 * i
        for x, cell in zip((0.06, 0.27, 0.36, 0.44), row, strict=True):
            page.text(x, y, cell, fontsize=7.5)
    shown = [
        name for name in PANELS if name in runs and (_path(there, runs[name]) / PICTURE).is_file()
    ]
    for i, name in enumerate(shown):
        axis = page.add_axes((0.04 + 0.47 * (i % 2), 0.455 - 0.215 * (i // 2), 0.46, 0.205))
        axis.imshow(np.asarray(Image.open(_path(there, runs[name]) / PICTURE).convert("RGB")))
        axis.set_axis_off()
    page.savefig(path)
    plt.close(page)
