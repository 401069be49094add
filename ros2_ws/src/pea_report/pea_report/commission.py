"""The page of a commissioning: what was identified, proposed, checked and measured."""

from __future__ import annotations

import base64
import datetime
import html
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pea_core.printable import printable
from pea_measure.analysis import margin_table, step_table
from pea_report.report import STYLE

PICTURE = "measurement.png"


def write(there: Path, title: str, found: Mapping[str, Any], runs: Mapping[str, str]) -> None:
    """Write ``commission.html`` into a directory; it needs no other file."""
    model, gains = found["identify"], found["propose"]
    parts = [
        f"<h1>{_text(title)}</h1>\n<p class=about>pea commission, "
        f"{datetime.datetime.now(datetime.UTC).isoformat(sep=' ', timespec='minutes')}</p>\n",
        "<h2>Identified</h2>\n",
        _table(
            ("parameter", "value", "half width of 95 %"),
            [
                (name, f"{row['value']:.5g}", _number(row.get("half_width_95")))
                for name, row in model["parameters"].items()
            ],
        ),
        *(f"<p>{_text(sentence)}</p>\n" for sentence in model["sentences"]),
        f"<h2>Proposed by {_text(gains['by'])}</h2>\n",
        _table(("gain", "value"), [(n, f"{v:.6g}") for n, v in gains["gains"].items()]),
        "<h2>Checked</h2>\n",
        _table(
            ("plant", "gain margin", "delay margin (samples)"),
            [
                (name, _number(row["gain_margin"]), _number(row["delay_margin_samples"]))
                for name, row in found["check"].items()
            ],
        ),
        "<h2>Measured with these gains</h2>\n",
        _table(
            ("margin", "measured", "95 %", "pea check", "at the slope of H", "unit"),
            margin_table(found["loop"]),
        ),
        _table(
            ("step (um)", "n", "rise (ms)", "settling (ms)", "overshoot (%)", "error (nm)"),
            step_table(found["steps"]),
        ),
    ]
    for name, run in runs.items():
        link = html.escape(os.path.relpath(run, there))
        parts.append(f'<h2>{_text(name)}</h2>\n<p>run: <a href="{link}">{link}</a></p>\n')
        file = Path(run) / PICTURE
        if file.is_file():
            data = base64.b64encode(file.read_bytes()).decode()
            parts.append(f'<img alt="{_text(name)}" src="data:image/png;base64,{data}">\n')
    page = (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">\n'
        f"<title>{_text(title)}</title>\n<style>{STYLE}</style></head>\n<body>\n"
        f"{''.join(parts)}</body></html>\n"
    )
    (there / "commission.html").write_text(page, encoding="utf-8")


def _text(value: str) -> str:
    return html.escape(printable(value))


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.4g}"


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    head = "".join(f"<th>{_text(h)}</th>" for h in heads)
    body = "".join(
        "<tr>" + "".join(f"<td>{_text(c)}</td>" for c in row) + "</tr>\n" for row in rows
    )
    return f"<div class=wide><table>\n<tr>{head}</tr>\n{body}</table></div>\n"
