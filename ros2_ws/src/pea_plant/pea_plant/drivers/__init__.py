"""What the plant can drive: drivers by name, our own and those that a lab installs.

A package of a lab's own names its module (see `pea_plant.drivers.driver`) in the entry point
group `GROUP`:

    [project.entry-points."pea.drivers"]
    my_amplifier = "my_package.my_amplifier"
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

from pea_core.axes import per_axis
from pea_core.entry import line_of
from pea_core.params import Choice, ParameterError
from pea_core.registry import BROKEN, models

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
    unusable=BROKEN.get(GROUP),
)


def driven(plant: Any, T_s: float, desired: Any, axes: Sequence[str] = ()) -> Any:
    """The plant of a loop in one process that is a device: of the driver's own kind, or any.

    Of several axes `plant` and what `desired` returns are tuples.

    A driver module whose cycle compiles offers ``driven``, with the arguments of
    `pea_plant.driven.Driven`.
    """
    from pea_plant.driven import Driven

    if type(plant) is tuple:
        return Driven(plant, T_s, desired, axes=axes)
    module = MODULES.get(CHOICE.type_of(plant.driver))
    return getattr(module, "driven", Driven)(plant, T_s, desired)


def together(axes: Sequence[str], plants: Sequence[Any]) -> None:
    """Refuse axes that are not driven as one device with a channel each, or all simulated.

    A driver module that drives several channels in one exchange offers ``several`` and names in
    ``CHANNEL`` the parameter that chooses one.

    Raises
    ------
    ParameterError
        The driver has one channel only, two axes have the same one, or anything else of the driver
        differs between them.
    """
    kinds = [CHOICE.type_of(plant.driver) for plant in plants]
    for axis, kind in zip(axes, kinds, strict=True):
        if kind != kinds[0]:
            raise ParameterError(
                f"{axis}.driver.type = {kind!r}: {axes[0]} has {kinds[0]!r}; axes of one loop have "
                "one device"
            )
    if kinds[0] == "simulated":
        return
    channel = getattr(MODULES[kinds[0]], "CHANNEL", "")
    if not channel:
        raise ParameterError(
            f"driver.type = {kinds[0]!r}: drives one channel, not the axes {', '.join(axes)}; "
            "give one axis with --set axes=NAME, or a device of several channels"
        )
    first = plants[0].driver
    taken: dict[str, str] = {}
    for axis, plant in zip(axes, plants, strict=True):
        own = getattr(plant.driver, channel)
        if own in taken:
            raise ParameterError(
                f"driver.{channel} = {own!r}: is the channel of {taken[own]} and of {axis}; give "
                f"each its own, with {taken[own]}.driver.{channel} and {axis}.driver.{channel}"
            )
        taken[own] = axis
        for field in fields(first):
            value = getattr(plant.driver, field.name)
            shared = field.name not in (channel, "calibration")
            if shared and value != getattr(first, field.name):
                raise ParameterError(
                    f"{axis}.driver.{field.name} = {value!r}: axes share a device; give "
                    f"driver.{field.name} for all"
                )


def check(each: tuple[Any, ...], T_s: float) -> None:
    """Refuse a device whose driver cannot be made, before a node starts; nothing is opened.

    Parameters
    ----------
    each : tuple of pea_plant.plant.Params
        One for each axis.
    T_s : float
        Sample period (s).

    Raises
    ------
    ParameterError
        As `make`.
    """
    if not isinstance(each[0].driver, Simulated):
        make(each if len(each) > 1 else each[0], T_s)


def make(plant: Any, T_s: float) -> Any:
    """The driver that the plant's parameters choose, not connected yet.

    Parameters
    ----------
    plant : pea_plant.plant.Params
        Of several axes a tuple of them, see `together`.
    T_s : float
        Sample period (s).

    Returns
    -------
    Driver

    Raises
    ------
    ParameterError
        It cannot be designed with them, or a Python package that it needs is missing.
    """
    several = type(plant) is tuple
    name = CHOICE.type_of((plant[0] if several else plant).driver)
    if name == "simulated":
        from pea_plant import specimen, stage
        from pea_plant.drivers import simulated

        actuators = [simulated.Simulated(own, T_s) for own in per_axis(plant)]
        driven: Any = actuators[0]
        if several:
            driven = stage.Stage(actuators, tuple(map(str, range(len(plant)))))
        driver = stage.Channels(driven) if several else driven
        lies = specimen.of(per_axis(plant))
        return driver if lies is None else specimen.Detecting(driver, driven, lies)
    module = MODULES[name]
    try:
        return module.several(plant, T_s) if several else module.make(plant, T_s)
    except ParameterError as error:
        raise ParameterError(f"driver.{error}") from None
    except ModuleNotFoundError as error:
        raise ParameterError(f"driver.type = {name!r}: {line_of(error)}") from None
