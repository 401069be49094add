"""``pea fmu``: the plant of an experiment for another simulator."""

from __future__ import annotations

import argparse
from typing import Any

from pea_cli.options import path_of, sets
from pea_core.console import out
from pea_experiment import experiments


def add(commands: Any) -> None:
    """Add the command to the parser's."""
    fmus = commands.add_parser(
        "fmu", help="the plant of an experiment as an FMU, for another simulator"
    )
    fmus.add_argument("experiment", metavar="EXPERIMENT", help="name, or path of a YAML file")
    fmus.add_argument("--out", metavar="FILE", type=path_of, required=True, help="new .fmu file")
    fmus.add_argument("--rig", metavar="NAME", help="rig whose stage to emulate, from config/rigs/")
    sets(fmus)


def _fmu(arguments: argparse.Namespace) -> int:
    from pea_lab.fmu import write

    experiment = experiments.load(arguments.experiment, arguments.sets, rig=arguments.rig)
    write(arguments.out, experiment)
    out.print(f"fmu  {arguments.out}", highlight=False, markup=False)
    return 0


COMMANDS = {"fmu": _fmu}
