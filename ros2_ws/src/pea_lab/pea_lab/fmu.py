"""The plant of an experiment as an FMU (FMI 2.0, co-simulation), for simulators that read one.

The FMU holds the same model as a run: the text of its packages, no copy. The simulator needs a
Python with numpy and scipy; nothing of pea has to be installed there.
"""

from __future__ import annotations

import dataclasses
import json
import re
import shutil
import sys
import tempfile
from importlib.util import find_spec
from pathlib import Path

from pythonfmu import FmuBuilder

from pea_core.params import ParameterError, flatten
from pea_experiment.experiment import Experiment
from pea_lab import fmu_slave
from pea_plant.model.actuator import Params
from pea_record.origin import VERSION

PACKAGES = ("pea_core", "pea_engine", "pea_drivers", "pea_native", "pea_plant", "pea_watchdog")
"""What the model and its parameters are made of."""

SUFFIX = ".fmu"


def write(path: Path, experiment: Experiment) -> None:
    """Write the plant of an experiment as an FMU.

    Raises
    ------
    ParameterError
        `path` is not to be written, or has another suffix.
    """
    if path.suffix != SUFFIX:
        raise ParameterError(f"{path}: give a name that ends in {SUFFIX}")
    if path.exists():
        raise ParameterError(f"{path} already exists")
    if not path.parent.is_dir():
        raise ParameterError(f"{path.parent}: is no directory; make it first")
    values = flatten(Params, experiment.nodes["plant"].params)
    of_the_model = {field.name for field in dataclasses.fields(Params)}
    values = {n: v for n, v in values.items() if n.partition(".")[0] in of_the_model}
    paths = sys.path.copy()
    with tempfile.TemporaryDirectory(prefix="pea_fmu_") as place:
        carried = {}
        for name in filter(values.get, fmu_slave.FILES):
            source = Path(str(values[name]))
            carried[name] = Path(place) / source.name
            shutil.copyfile(source, carried[name])
            values[name] = source.name
        told = {
            "name": re.sub(r"\W", "_", f"pea_{experiment.name}", flags=re.ASCII),
            "description": f"Simulated piezo actuator of the experiment {experiment.name}",
            "version": VERSION,
            "T_s": experiment.T_s,
            "duration": experiment.samples * experiment.T_s,
            "values": values,
        }
        written = Path(place) / "plant.json"
        written.write_text(json.dumps(told, indent=1), encoding="utf-8")
        script = Path(place) / "pea_fmu_plant.py"
        shutil.copyfile(str(fmu_slave.__file__), script)
        packages = [_bare(name, Path(place) / "packages") for name in PACKAGES]
        try:
            FmuBuilder.build_FMU(script, path, [written, *carried.values(), *packages])
        finally:
            sys.path[:] = paths
            sys.modules.pop(script.stem, None)


def _bare(name: str, place: Path) -> Path:
    """A copy of a package without what Python has compiled."""
    found = find_spec(name)
    assert found is not None
    assert found.origin is not None
    of = Path(found.origin).parent
    return Path(shutil.copytree(of, place / name, ignore=shutil.ignore_patterns("__pycache__")))
