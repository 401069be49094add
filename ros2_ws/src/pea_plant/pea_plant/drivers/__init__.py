"""What the plant can drive: drivers by name, our own and those that a lab installs.

A package of a lab's own names its module (see `pea_plant.drivers.driver`) in the entry point
group `GROUP`:

    [project.entry-points."pea.drivers"]
    my_amplifier = "my_package.my_amplifier"
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from pea_core.params import Choice, ParameterError
from pea_core.registry import models

GROUP = "pea.drivers"


@dataclass(frozen=True)
class Simulated:
    """The simulated actuator, in lock-step or in wall time."""


MODULES = models(GROUP, {}, ("make",), first="pea_drivers")
MODULES.pop("simulated", None)
"""Drivers of devices by name: ours (`pea_drivers`), then those of a lab."""

CHOICE = Choice(
    {"simulated": Simulated, **{name: module.Params for name, module in MODULES.items()}},
    "simulated",
    "what is driven: a simulated actuator, or a device",
)


def driven(plant: Any, T_s: float, desired: Any) -> Any:
    """The plant of a loop in one process that is a device: of the driver's own kind, or any.

    A driver module whose cycle compiles offers ``driven``, with the arguments of
    `pea_plant.driven.Driven`.
    """
    from pea_plant.driven import Driven

    module = MODULES.get(CHOICE.type_of(plant.driver))
    return getattr(module, "driven", Driven)(plant, T_s, desired)


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
