"""What the plant can drive: drivers by name, our own and those that a lab installs.

A package of a lab's own names its module (see `pea_plant.drivers.driver`) in the entry point
group `GROUP`:

    [project.entry-points."pea.drivers"]
    my_amplifier = "my_package.my_amplifier"
"""

from __future__ import annotations

import importlib
import importlib.metadata
from dataclasses import dataclass
from types import ModuleType
from typing import Any

from pea_core.params import Choice, ParameterError

GROUP = "pea.drivers"

OWN = {
    "gcs": "pea_drivers.gcs",
    "modbus_daq": "pea_drivers.modbus_daq",
    "nv200": "pea_drivers.nv200",
}
"""Modules of this package's drivers of real devices."""

BROKEN: dict[str, str] = {}
"""Drivers that cannot be imported, and why."""


@dataclass(frozen=True)
class Simulated:
    """The simulated actuator, in lock-step or in wall time."""


def _found() -> dict[str, ModuleType]:
    """Module of each driver that can be imported; our own cannot be replaced."""
    named = {point.name: point.value for point in importlib.metadata.entry_points(group=GROUP)}
    modules = {}
    for name, module in {**named, **OWN}.items():
        try:
            modules[name] = importlib.import_module(module)
            Choice({name: modules[name].Params}, name, "")
        except Exception as error:
            if name in OWN:
                raise
            modules.pop(name, None)
            BROKEN[name] = " ".join(f"{type(error).__name__}: {error}".split())
    return modules


MODULES = _found()

CHOICE = Choice(
    {"simulated": Simulated, **{name: module.Params for name, module in MODULES.items()}},
    "simulated",
    "what is driven: a simulated actuator, or a device",
)


def make(plant: Any, T_s: float) -> Any:
    """The driver that the plant's parameters choose, not connected yet.

    Parameters
    ----------
    plant : pea_plant.plant.Params
    T_s : float
        Sample period (s).

    Returns
    -------
    Driver

    Raises
    ------
    ParameterError
        It cannot be designed with them.
    """
    name = CHOICE.type_of(plant.driver)
    if name == "simulated":
        from pea_plant.drivers import simulated

        return simulated.Simulated(plant, T_s)
    try:
        return MODULES[name].make(plant, T_s)
    except ParameterError as error:
        raise ParameterError(f"driver.{error}") from None
