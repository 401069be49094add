"""A rig: one YAML file in ``config/rigs/`` that is laid over an experiment.

It says what is driven (``plant.driver``), its limits (``plant.voltage_min``, ``plant.safety``),
its rate (``T_s``), and which observer and controller suit that rate. What it says of the
reference and of the run is nothing: that is the experiment's. Its section ``emulator`` is for
``pea emulate`` alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pea_core import config
from pea_core.config import NODES, Source
from pea_core.params import build, param
from pea_experiment.experiment import SCHEMAS

FOLDER = "rigs"
SECTION = "rig"
EMULATOR = "emulator"


@dataclass(frozen=True)
class RigParams:
    """What the rig's file says of itself."""

    description: str = param("", help="one line for people")


def read(name: str) -> dict[str, dict[str, Any]]:
    """Sections of a rig's file: `SECTION`, each of `NODES`, `EMULATOR`.

    Parameters
    ----------
    name : str
        Name in ``config/rigs/``, or path of a file.

    Raises
    ------
    ParameterError
        No such rig, or not a file of that form.
    """
    path = path_of(name)
    values = config.read(path, (SECTION, *NODES, EMULATOR))
    build(RigParams, values[SECTION], f"{path.stem}: ")
    return values


def path_of(name: str) -> Path:
    """File of a rig.

    Raises
    ------
    ParameterError
        There is none.
    """
    return config.find(FOLDER, name, "rig")


def names() -> dict[str, str]:
    """Every rig in ``config/rigs/``, and those of a lab's packages, as `experiments.names`."""

    def description(name: str, path: Path) -> str:
        values = read(str(path))
        sources = {
            node: [Source(config.absolute(values[node], path.parent), name)] for node in NODES
        }
        axes = config.axes_of("plant", sources["plant"])
        for node in NODES:
            sources[node].insert(0, Source({"axes": axes}, "the plant"))
            config.resolve_axes(node, SCHEMAS[node], sources[node])
        return str(values[SECTION].get("description", ""))

    return config.described(FOLDER, description)
