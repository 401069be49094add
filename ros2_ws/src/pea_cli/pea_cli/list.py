"""``pea list``: experiments, laws, observers, references and presets."""

from __future__ import annotations

import argparse
import dataclasses
import json
from collections.abc import Callable
from itertools import takewhile
from pathlib import Path
from typing import Any

from rich.table import Table

from pea_core import config, registry
from pea_core.config import NODES
from pea_core.console import out
from pea_core.params import Choice
from pea_experiment import experiments, rig
from pea_experiment.experiment import SCHEMAS
from pea_plant import drivers

LISTED = (
    ("controllers", "pea.laws", ""),
    ("observers", "pea.observers", ""),
    ("references", "pea.references", ""),
    ("plants", "pea.hysteresis", "hysteresis.type="),
    ("plants", "pea.creep", "creep.type="),
    ("plants", "pea.vibration", "vibration.type="),
    ("plants", "pea.loads", "load.type="),
    ("drivers", drivers.GROUP, ""),
)
"""Where a list names models of an entry point group, and how it writes them."""


def add(commands: Any) -> None:
    """Add the command to the parser's."""
    parser = commands.add_parser(
        "list", help="experiments, laws, observers, references and presets"
    )
    parser.add_argument("--json", action="store_true", help="as JSON")


def lists() -> dict[str, Any]:
    """Experiments, models of each kind, presets, drivers and rigs, with a line on each."""
    found: dict[str, Any] = {"experiments": experiments.names()}
    for node in NODES:
        schema = SCHEMAS[node]
        if isinstance(schema, Choice):
            found[f"{node}s"] = _kinds(schema)
        else:
            found[f"{node}s"] = {
                f"{field.name}.type={name}": text
                for field in dataclasses.fields(schema)
                if isinstance(choice := field.metadata.get("group"), Choice)
                and choice is not drivers.CHOICE  # they have a list of their own
                for name, text in _kinds(choice).items()
            }
        presets = config.described(config.FOLDERS.get(node, node), _head)
        if presets:
            found[f"{node} presets"] = presets
    found["drivers"] = _kinds(drivers.CHOICE)
    for title, group, begin in LISTED:
        broken = registry.BROKEN.get(group, {})
        found[title] |= {begin + name: f"cannot be used: {why}" for name, why in broken.items()}
    found["rigs"] = rig.names()
    return found


def _head(preset: str, path: Path) -> str:
    """First sentence of the comment at the head of a preset's file."""
    lines = path.read_text(encoding="utf-8").split("\n")
    comment = " ".join(line.lstrip("# ") for line in takewhile(lambda t: t.startswith("#"), lines))
    sentence, ends, _ = comment.partition(". ")
    return sentence + ends.strip()


def _about(thing: object) -> str:
    """First line of a docstring."""
    return (thing.__doc__ or "").split("\n")[0]


def _kinds(choice: Choice) -> dict[str, str]:
    return {name: _about(kind) for name, kind in choice.kinds.items()}


def _list(arguments: argparse.Namespace) -> int:
    found = lists()
    if arguments.json:
        print(json.dumps(found), flush=True)
        return 0
    for title, entries in found.items():
        table = Table("name", "", title=title, title_justify="left", show_header=False)
        for name, text in entries.items():
            table.add_row(name, text)
        out.print(table)
    return 0


COMMANDS: dict[str, Callable[[argparse.Namespace], int]] = {"list": _list}
