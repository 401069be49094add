"""A PI controller in volts and metres."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from pea_core.params import group, param
from pea_plant.drivers import calibration


@dataclass(frozen=True)
class Params:
    """PI controller by the General Command Set 2.0, over TCP or a serial line."""

    address: str = param("tcp://127.0.0.1:50000", help="tcp://HOST:PORT or serial:…", fixed=True)
    axis: str = param("1", help="axis of the controller", fixed=True)
    timeout_s: float = param(0.1, "s", 1e-3, 60.0, help="longest wait for an answer", fixed=True)
    calibration: calibration.Params = group(calibration.Params)


def make(plant: Any, T_s: float) -> Any:
    """Driver for the plant's parameters."""
    raise NotImplementedError
