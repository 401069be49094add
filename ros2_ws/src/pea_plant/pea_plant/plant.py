"""Parameters of the plant: the actuator, and what drives it."""

from dataclasses import dataclass
from typing import Any

from pea_core.params import choice, group
from pea_plant import drivers
from pea_plant.model import actuator
from pea_plant.model import stage as coupling


@dataclass(frozen=True)
class Params(actuator.Params):
    """The plant: an actuator, simulated or behind the driver of a device."""

    driver: Any = choice(
        drivers.CHOICE.kinds, drivers.CHOICE.default, help=drivers.CHOICE.spec.help
    )
    stage: coupling.Params = group(coupling.Params)
