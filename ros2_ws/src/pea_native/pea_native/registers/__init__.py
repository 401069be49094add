"""Memory-mapped registers, as of pea_registers.h: a card's BAR, a Zynq, /dev/uio0."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from pea_core.params import param
from pea_native import device
from pea_native.native import driven

__all__ = ["Params", "driven", "make"]


@dataclass(frozen=True)
class Params(device.Params):
    """Memory-mapped registers, as of pea_registers.h: a card's BAR, a Zynq, /dev/uio0."""

    address: str = param(
        "/dev/shm/pea_registers",
        help="file that is mapped: /dev/uio0, resource0 of a PCI card",
        fixed=True,
    )


def make(plant: Any, T_s: float) -> device.Native:
    """The driver of a plant's parameters, not connected.

    Raises
    ------
    ParameterError
        Its library cannot be compiled.
    """
    return device.of_package("registers", plant, T_s)
