"""Parameters of the plant: the actuator, and what drives it."""

from dataclasses import dataclass
from typing import Any

from pea_core.params import choice
from pea_plant import drivers
from pea_plant.model import actuator


@dataclass(frozen=True)
class Params(actuator.Params):
    """The plant: an actuator, simulated or behind the driver of a device."""

    driver: Any = choice(
        drivers.CHOICE.kinds, drivers.CHOICE.default, help=drivers.CHOICE.spec.help
    )
