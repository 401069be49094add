"""A driver of a lab's own: a shared library of pea_driver.h, or the C that one is made of."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pea_core.params import ParameterError, param
from pea_core.paths import given
from pea_native import build, device

SOURCE = ".c"


@dataclass(frozen=True)
class Params(device.Params):
    """Shared library of one's own, called from the compiled loop."""

    library: str = param(
        "", help="path of a shared library of pea_driver.h, or of its C source", fixed=True
    )


def make(plant: Any, T_s: float) -> device.Native:
    """The driver of a plant's parameters, not connected.

    Raises
    ------
    ParameterError
        There is no such library, or it cannot be compiled.
    """
    return device.Native(plant.driver, plant, T_s, library_of(plant.driver.library))


def library_of(text: str) -> Path:
    """Path of a shared library that somebody has named, compiled where it is C."""
    if not text:
        raise ParameterError(
            "library = '': give the path of a shared library (.so) or C source (.c)"
        )
    path = given(text, "library").absolute()
    if not path.is_file():
        raise ParameterError(f"library = {text!r}: there is no such file")
    return build.made([path], path.stem) if path.suffix == SOURCE else path


def driven(*arguments: Any) -> Any:
    """The plant of a loop in wall time, with the cycle compiled."""
    from pea_native.driven import NativeDriven

    return NativeDriven(*arguments)
