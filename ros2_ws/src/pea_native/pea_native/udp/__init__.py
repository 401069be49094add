"""A board that talks frames over UDP (examples/board): Teensy, STM32, Zynq, an FPGA."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from pea_core.params import param
from pea_native import device, library
from pea_native.native import driven

__all__ = ["Params", "driven", "make"]


@dataclass(frozen=True)
class Params(device.Params):
    """A board that talks frames over UDP (examples/board): Teensy, STM32, Zynq, an FPGA."""

    address: str = param("udp://127.0.0.1:20000", help="udp://HOST:PORT", fixed=True)
    pace: str = param(
        library.DEVICE,
        help="whose clock a sample waits for: the computer's, or the device's",
        choices=library.PACES,
        fixed=True,
    )


def make(plant: Any, T_s: float) -> device.Native:
    """The driver of a plant's parameters, not connected.

    Raises
    ------
    ParameterError
        Its library cannot be compiled.
    """
    return device.of_package("udp", plant, T_s)
