"""The simulated plant within an FMU: what a simulator's `doStep` carries on.

`pea_lab.fmu` puts this file into the FMU, beside the packages of the model and ``plant.json``, the
parameters. A step is a whole number of sample periods. Within one the input u is held, as by the
DAC: the outputs are those of the sample at its end.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any
from xml.etree.ElementTree import Element, SubElement

from pythonfmu import (
    Boolean,
    DefaultExperiment,
    Fmi2Causality,
    Fmi2Slave,
    Fmi2Variability,
    Integer,
    Real,
)

from pea_core.params import build, specs
from pea_plant.drivers.simulated import Simulated
from pea_plant.model.actuator import Params

KINDS = {bool: Boolean, int: Integer, float: Real}
"""Variable of FMI for a parameter; texts and lists are those that were exported."""

OUTPUTS = {
    "y": "measured displacement (m)",
    "u_applied": "voltage applied in the interval before (V)",
    "x1": "true displacement (m)",
    "x2": "true velocity (m/s)",
}

FILES = ("load.path",)
"""Parameters that name a file, which the FMU carries."""

WHOLE = 1e-6
"""Share of a sample period by which a step may miss a whole number of them."""


class Plant(Fmi2Slave):
    """The plant of an experiment, at rest at the beginning."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        told = json.loads((Path(self.resources) / "plant.json").read_text(encoding="utf-8"))
        self.author, self.version = "pea", told["version"]
        self.modelName, self.description = told["name"], told["description"]
        self.T_s: float = told["T_s"]
        self.default_experiment = DefaultExperiment(0.0, told["duration"], self.T_s)
        self.values: dict[str, Any] = told["values"]
        self.u = 0.0
        self.out = dict.fromkeys(OUTPUTS, 0.0)
        self.begin()
        put = partial(self.register_variable, nested=False)
        put(Real("u", causality=Fmi2Causality.input, description="commanded voltage (V)"))
        for name, text in OUTPUTS.items():
            put(
                Real(
                    name,
                    causality=Fmi2Causality.output,
                    description=text,
                    getter=partial(self.out.__getitem__, name),
                )
            )
        for name, spec in specs(Params, self.values).items():
            if spec.kind in KINDS:
                put(
                    KINDS[spec.kind](
                        name,
                        causality=Fmi2Causality.parameter,
                        variability=Fmi2Variability.fixed,
                        description=f"{spec.help} ({spec.unit})" if spec.unit else spec.help,
                        getter=partial(self.values.__getitem__, name),
                        setter=partial(self.values.__setitem__, name),
                    )
                )

    def to_xml(self, model_options: Mapping[str, str] = MappingProxyType({})) -> Element:
        """Model description; it names the outputs once more as what initialization finds out."""
        root = super().to_xml(model_options)
        structure = root.find("ModelStructure")
        found = structure.findall("Outputs/Unknown")
        SubElement(structure, "InitialUnknowns").extend(found)
        return root

    def begin(self) -> None:
        """Go to rest, with the parameters as they are.

        Raises
        ------
        ParameterError
            One is out of its range.
        """
        values = {n: tuple(v) if isinstance(v, list) else v for n, v in self.values.items()}
        for name in filter(values.get, FILES):
            values[name] = str(Path(self.resources) / str(values[name]))
        self.plant = Simulated(build(Params, values), self.T_s)
        self.sample()

    def sample(self) -> None:
        """Measure."""
        measured, truth = self.plant.read(), self.plant.truth
        self.out.update(y=measured.y, u_applied=measured.u_applied, x1=truth.x1, x2=truth.x2)

    def exit_initialization_mode(self) -> None:
        """Take what was set."""
        self.begin()

    def do_step(self, current_time: float, step_size: float) -> bool:
        """Apply u (V) until the end of the step (s)."""
        periods = step_size / self.T_s
        samples = round(periods)
        if samples < 1 or abs(periods - samples) > WHOLE or not math.isfinite(self.u):
            self.log(f"step {step_size} s: give a multiple of {self.T_s} s, and a finite u")
            return False
        for _ in range(samples):
            self.plant.write(self.u)
            self.sample()
        return True
