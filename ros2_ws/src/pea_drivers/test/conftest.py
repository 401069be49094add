"""Emulated devices, each with drivers of it: fixtures of the tests of all drivers and of each."""

from __future__ import annotations

import dataclasses
import importlib
from collections.abc import Iterator
from typing import Any

import pytest

from pea_core.params import ParameterError, build
from pea_plant import drivers
from pea_plant.plant import Params

PATIENT = 20.0
"""Time-out (s) where none is to be tested: the machine may be busy."""

RIGS: dict[str, dict[str, Any]] = {
    "gcs": {},
    "modbus_daq": {
        "driver.calibration.amplifier": (0.75, 0.0375),  # 0 V at -20 V, 4.875 V at 110 V
        "driver.calibration.sensor": (1.0, 2.0),  # 1 um at 0 V
    },
    "nv200": {},
}
"""What the plant of each kind of device has besides."""

QUICK: dict[str, dict[str, Any]] = {
    "gcs": {"latency_s": 0.0},
    "modbus_daq": {"latency_s": 0.0, "dac_bits": 0, "ain_bits": 0},
    "nv200": {"latency_s": 0.0, "baud": 0.0},
}
"""Emulated devices without timing and without steps."""


class Bench:
    """One kind of device, emulated."""

    def __init__(self, kind: str) -> None:
        self.kind = kind
        self.emulator = importlib.import_module(f"pea_drivers.{kind}.emulator")
        self.quick = self.emulator.Params(**QUICK[kind])

    def plant(self, address: str = "tcp://127.0.0.1:1", **values: Any) -> Any:
        """Parameters of a plant; ``driver__axis`` is ``driver.axis``."""
        given = {name.replace("__", "."): value for name, value in values.items()}
        base = {"driver.type": self.kind, "driver.address": address, "driver.timeout_s": PATIENT}
        base["driver.connect_s"] = PATIENT
        return build(Params, {**base, **RIGS[self.kind], **given})

    def make(self, address: str = "tcp://127.0.0.1:1", **values: Any) -> Any:
        """A driver, not connected."""
        return drivers.make(self.plant(address, **values), 2e-3)

    def driver(self, device: Any, **values: Any) -> Any:
        """A driver of an emulated device, not connected."""
        return self.make(device.address, **values)

    def emulated(self, plant: Any = None, port: int | None = 0, **values: Any) -> Any:
        """An emulated device, with some of its parameters."""
        params = dataclasses.replace(self.quick, **values)
        return self.emulator.make(plant or self.plant(), params, port)

    def refuses(self, device: Any, says: str, **of_rig: Any) -> None:
        """See that a driver refuses a device in one line, and that nothing was commanded."""
        driver = self.driver(device, **of_rig)
        with pytest.raises(ParameterError, match=says) as refusal:
            driver.connect()
        assert "\n" not in str(refusal.value)
        assert self.untouched(device)
        assert driver.fileno() == -1

    @staticmethod
    def untouched(device: Any) -> bool:
        """Whether no voltage was ever commanded."""
        return "commands" not in device.told()["counts"]


@pytest.fixture(params=sorted(RIGS))
def kind(request: pytest.FixtureRequest) -> str:
    """Kind of the device; a module that is about one has a fixture of its own."""
    return str(request.param)


@pytest.fixture
def bench(kind: str) -> Bench:
    return Bench(kind)


@pytest.fixture
def device(bench: Bench) -> Iterator[Any]:
    with bench.emulated() as emulated:
        yield emulated


@pytest.fixture
def driver(bench: Bench, device: Any) -> Iterator[Any]:
    connected = bench.driver(device)
    connected.connect()
    yield connected
    connected.close()
