"""Answers of devices: one of those that a driver gets, from its first question on, is spoilt.

An input is four bytes and what the device says in place of an answer, before it, or behind it:
kind of the device, which answer, size of the pieces in which it comes, place. A driver connects,
exchanges and checks; whatever it refuses it refuses in one line, and no displacement that it
tells after the spoilt answer belongs to another question.
"""

from __future__ import annotations

import importlib
import math
import random
from collections.abc import Iterator
from functools import cache
from typing import Any

from pea_fuzz import SPECIAL, mutated, one_line

KINDS = ("gcs", "nv200", "modbus_daq")
ANSWERS = 26
"""Answers of which one is spoilt: connecting takes some 20."""

Y = 2e-6
"""Displacement (m) of a stage that stands still."""

PIECES = (
    *SPECIAL,
    b" \n",
    b"1=",
    b"1=7.5\n",
    b"=",
    b"\r\n",
    b"\x11",
    b"\x13",
    b"\x13meas,7.5\r\n\x11",
    b"\x13error,8\r\n\x11",
    b"\x13\x11",
    b"\xff\xfd\x03",
    b"\xff\xfa",
    b"\x00\x00\x00\x06\x01",
    b"\x00\x05\x00\x00\x00\x06\x01\x4c\x40\xf0\x00\x00",
    b"\x7f\xc0\x00\x00",
)


@cache
def emulated(kind: str) -> Any:
    """An emulated device that stands still, and a driver of it."""
    from pea_core.params import build
    from pea_plant import drivers
    from pea_plant.plant import Params

    values: dict[str, Any] = {"driver.type": kind, "driver.address": "tcp://127.0.0.1:1"}
    if kind == "modbus_daq":
        values["driver.calibration.amplifier"] = (0.75, 0.0375)
    module = importlib.import_module(f"pea_drivers.{kind}.emulator")
    plant = build(Params, values)
    device = module.make(plant, module.Params(), 0)
    device.stage.reading = lambda: Y
    device.stage.motion.drive = lambda u: None
    return device, drivers.make(plant, 1e-3)


class Spoilt:
    """A way to an emulated device whose answer `which` is spoilt.

    Attributes
    ----------
    told : list of bytes
        Its answers.
    """

    def __init__(self, kind: str, which: int, size: int, place: int, data: bytes) -> None:
        self.address, self.deadline = "fuzz", None
        self._session = emulated(kind)[0].session()
        self._which, self._size, self._place, self._data = which, size, place, data
        self._coming = b""
        self.told: list[bytes] = []

    def send(self, data: bytes) -> None:
        """Hand a request to the device, and keep its answer."""
        answer = self._session.feed(data)
        if not answer:
            return
        self.told.append(answer)
        if len(self.told) == self._which + 1:
            half = len(answer) // 2
            answer = (
                self._data,
                self._data + answer,
                answer + self._data,
                answer[:half] + self._data + answer[half:],
            )[self._place]
        self._coming += answer

    def receive(self) -> bytes:
        """A piece of what has come; the deadline, where that is nothing."""
        from pea_plant.drivers.driver import DriverError

        if not self._coming:
            raise DriverError("fuzz: no answer within 0.1 s")
        piece, self._coming = self._coming[: self._size], self._coming[self._size :]
        return piece

    def comes_within(self, seconds: float) -> bool:
        """Whether something has come."""
        return bool(self._coming)

    def drop(self) -> None:
        """Forget it."""
        self._coming = b""

    @property
    def spoilt(self) -> bool:
        """Whether the spoilt answer has gone."""
        return len(self.told) > self._which

    def fileno(self) -> int:
        """There is none."""
        return -1

    def close(self) -> None:
        """Nothing to do."""


def attempt(data: bytes) -> None:
    """Drive a device, one answer of which is spoilt."""
    from pea_core.params import ParameterError
    from pea_drivers import transport
    from pea_plant.drivers.driver import DriverError

    if len(data) < 4:
        return
    kind = KINDS[data[0] % len(KINDS)]
    way = Spoilt(kind, data[1] % ANSWERS, data[2] or 4096, data[3] % 4, data[4:])
    driver = emulated(kind)[1]
    connect, transport.connect = transport.connect, lambda address, deadline: way
    try:
        driver.connect()
    except ParameterError as error:
        one_line(error)
        return
    finally:
        transport.connect = connect
    for act in (driver.exchange, driver.read, driver.check) * 3:
        before = way.spoilt
        try:
            measured = act(10.0) if act == driver.exchange else act()
        except DriverError as error:
            one_line(error)
            continue
        if measured is not None:
            assert math.isfinite(measured.y), measured
            assert not before or abs(measured.y - Y) < 1e-9, (kind, measured)


def fuzz(seed: int, n: int) -> Iterator[bytes]:
    """Answers that devices give, changed."""
    draw = random.Random(seed)
    known = {kind: _said(kind) for kind in KINDS}
    for _ in range(n):
        kind = draw.randrange(len(KINDS))
        said = known[KINDS[kind]]
        which = draw.randrange(min(ANSWERS, len(said)))
        answer = said[which] if draw.random() < 0.6 else draw.choice(said)
        piece = draw.choice((0, 0, 1, 3, 17))
        spoilt = mutated(draw, answer, PIECES) if draw.random() < 0.8 else answer
        yield bytes([kind, which, piece, draw.choice((0, 0, 1, 2, 3))]) + spoilt


def _said(kind: str) -> list[bytes]:
    """What a device answers to a driver."""
    from pea_drivers import transport

    way = Spoilt(kind, 10**6, 4096, 0, b"")
    driver = emulated(kind)[1]
    connect, transport.connect = transport.connect, lambda address, deadline: way
    try:
        driver.connect()
    finally:
        transport.connect = connect
    for _ in range(4):
        driver.exchange(10.0)
        driver.read()
        driver.check()
    return way.told
