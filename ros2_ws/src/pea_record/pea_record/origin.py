"""Where a recording comes from: all that repeats the run, kept inside the bag."""

from __future__ import annotations

import datetime
import platform
import subprocess
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from pea_core import config
from pea_record import carried

ORIGIN = "pea"
"""Name of the metadata record."""

FORMAT = "1"
"""Version of what the record means."""

VERSION = "0.1.0"
"""Version of this software."""


@cache
def commit() -> str:
    """Commit of the source tree, ``-dirty`` where files differ from it; empty outside of git."""
    here = Path(__file__).resolve().parent
    try:
        found = subprocess.run(
            ["git", "-C", str(here), "describe", "--always", "--dirty", "--abbrev=40"],
            capture_output=True,
            text=True,
            timeout=2.0,
        )
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return found.stdout.strip() if found.returncode == 0 else ""


MAPPING_MAX, DEPTH_MAX = 1 << 20, 32
"""Characters of a text of YAML in a recording, and mappings inside each other."""


def mapping(text: str) -> dict[Any, Any]:
    """What a text of YAML maps; empty where it is none, as in a damaged recording."""
    if len(text) > MAPPING_MAX:
        return {}
    loader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    depth = 0
    try:
        for event in yaml.parse(text, Loader=loader):
            depth += isinstance(event, yaml.CollectionStartEvent)
            depth -= isinstance(event, yaml.CollectionEndEvent)
            if isinstance(event, yaml.AliasEvent) or depth > DEPTH_MAX:
                return {}  # we write none: one alias can stand for very much
        found = yaml.load(text, Loader=loader)
    except (yaml.YAMLError, ValueError, RecursionError):
        return {}
    except (AttributeError, LookupError, TypeError):  # a tag whose text is not of its kind
        return {}
    return found if isinstance(found, dict) else {}


def _seeds(plant: Mapping[str, object]) -> list[str]:
    """Seeds of a plant, one an axis."""
    return [str(value) for name, value in plant.items() if name.rpartition(".")[2] == "seed"]


def origin(
    name: str,
    sections: Mapping[str, Mapping[str, object]],
    mode: str,
    T_ns: int,
    folder: Path | None = None,
) -> dict[str, str]:
    """The record of a run.

    Parameters
    ----------
    name : str
        Name of the experiment.
    sections : mapping
        Values of the experiment and of each node, as in ``params.yaml``; empty where no node
        tells them.
    mode : str
        How it runs.
    T_ns : int
        Sample period (ns).
    folder : Path, optional
        Where names of files in the sections begin that are not absolute.
    """
    files = carried.contents(sections, folder)
    sections = {node: {**values, **_no_preset(values)} for node, values in sections.items()}
    return {
        "format": FORMAT,
        "experiment": name,
        "parameters": config.dump(sections) if sections else "",
        "mode": mode,
        "seed": ", ".join(dict.fromkeys(_seeds(sections.get("plant", {})))),
        "sample_period_ns": str(T_ns),
        "version": VERSION,
        "commit": commit(),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "machine": platform.platform(),
        "recorded": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        **{carried.PREFIX + name: text for name, text in files.items()},
    }


def _no_preset(values: Mapping[str, object]) -> dict[str, str]:
    """Every value is there: no preset is needed."""
    return {"preset": ""} if values.get("preset") else {}


def words(record: Mapping[str, str]) -> dict[str, str]:
    """What the record says in a few words each: without parameters and files."""
    return {
        name: value
        for name, value in record.items()
        if name != "parameters" and not name.startswith(carried.PREFIX)
    }
