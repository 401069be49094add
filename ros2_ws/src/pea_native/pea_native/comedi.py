"""A data acquisition card through comedi: one output, one input."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from pea_core.params import param
from pea_native import device
from pea_native.native import driven

__all__ = ["Params", "driven", "make"]


@dataclass(frozen=True)
class Params(device.Params):
    """A data acquisition card through comedi: one output, one input."""

    address: str = param(
        "/dev/comedi0", help="/dev/comediN?out=0&in=0&amplifier=A:B&sensor=A:B", fixed=True
    )


def make(plant: Any, T_s: float) -> device.Native:
    """The driver of a plant's parameters, not connected.

    Raises
    ------
    ParameterError
        Its library cannot be compiled.
    """
    return device.of_package("comedi", plant, T_s, ["comedi"])
