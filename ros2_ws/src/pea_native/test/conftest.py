"""A compiler, and a driver without a device; without a compiler the tests are skipped."""

from __future__ import annotations

import ctypes
import os
from pathlib import Path
from typing import Any

import pytest

from pea_core.params import build
from pea_native import build as c
from pea_plant.plant import Params

TOY = Path(__file__).with_name("toy.c")

if not c.compiler():
    pytest.skip("no C compiler: compiled drivers are not tested", allow_module_level=True)

GOOD = f"good {os.getpid()}"
"""No other process that tests has a device of this address."""

SAFETY = {
    "slew_rate": 2e5,
    "beyond": 200.0,
    "slew_samples": 0,
    "stale_samples": 20_000,
    "jump_um": 20.0,
    "stuck_samples": 900,
}


def _plant(address: str, **values: Any) -> Any:
    """Parameters of a plant with the toy for its driver."""
    given = {
        "driver.type": "native",
        "driver.library": str(TOY),
        "driver.address": address.replace("good", GOOD),
        "driver.timeout_s": 0.5,
        "voltage_min": -20.0,
        "voltage_max": 110.0,
        **{f"safety.{name}": value for name, value in SAFETY.items()},
    }
    return build(Params, {**given, **values})


@pytest.fixture(scope="session")
def plant() -> Any:
    """Makes parameters of a plant with the toy for its driver."""
    return _plant


@pytest.fixture(scope="session")
def toy() -> Any:
    """The toy as ctypes loads it: what it was given."""
    return ctypes.CDLL(str(c.made([TOY], "toy")))


def _given(toy: Any) -> list[float]:
    """Voltages (V) that the toy was given last."""
    count = ctypes.c_long.in_dll(toy, "toy_count").value
    volts = (ctypes.c_double * 65536).in_dll(toy, "toy_given")
    count = min(count, 65536)
    return list(volts[:count])


@pytest.fixture
def given(toy: Any) -> Any:
    """What the toy has been given in this test (V)."""
    ctypes.c_long.in_dll(toy, "toy_count").value = 0
    return lambda: _given(toy)
