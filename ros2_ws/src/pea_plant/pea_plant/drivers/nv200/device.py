"""An NV200/D in volts and metres."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import Any

from pea_core.params import ParameterError, param
from pea_core.signals import Measurement
from pea_plant.drivers import device, transport
from pea_plant.drivers.driver import Limits
from pea_plant.drivers.nv200 import protocol

MODEL = "NV200"
"""How the name of the device starts."""

MEASURE = protocol.command("meas")
IDENTIFY = protocol.END


@dataclass(frozen=True)
class Params(device.Params):
    """NV200/D of piezosystem jena, over a serial line or Telnet, one channel."""

    address: str = param(
        "serial:/dev/ttyUSB0", help="serial:/dev/NAME, or tcp://HOST:23 for Telnet", fixed=True
    )
    pipelined: bool = param(
        True, help="meas and set in one write; false: set when the device is ready", fixed=True
    )

    def __post_init__(self) -> None:
        _, _, options = transport.parse(self.address)
        if options.get("xonxoff"):
            raise ParameterError(
                f"address = {self.address!r}: XON and XOFF frame the answers; leave xonxoff out"
            )


class Nv200(device.Device):
    """Driver of an NV200/D; see `device.Device`."""

    NAME = MODEL

    def exchange(self, u: float) -> Measurement:
        """Measure and set u (V), in one write.

        In this order: on a serial line the second command comes half a millisecond later, in
        which a stage has moved.
        """
        self._recover()
        applied, line = self._u, self._line(u)
        if self._params.pipelined:
            reply = self._ask(MEASURE + line, "meas", "")
        else:
            reply = self._ask(MEASURE, "meas")
            self._ask(line, "")
        return Measurement(self._sensor(protocol.number(reply)), math.nan, applied)

    def read(self) -> Measurement:
        """Measure."""
        self._recover()
        y = self._sensor(protocol.number(self._ask(MEASURE, "meas")))
        return Measurement(y, math.nan, self._u)

    def write(self, u: float) -> None:
        """Set u (V)."""
        self._send(self._line(u))

    def check(self) -> None:
        """Read the status register."""
        self._recover()
        status = int(self._value("stat"))
        wrong = [name for bit, name in protocol.FAILURES.items() if status & bit]
        if status & protocol.CLOSED_LOOP:
            wrong.append("its loop is closed, two controllers would fight")
        if not status & protocol.CONNECTED:
            wrong.append("no actuator connected")
        if wrong:
            raise self._wrong(f"{', '.join(wrong)}; see to the device, then start again")

    def last_resort(self, u: float) -> bytes:
        """Set u (V), whatever line was begun before."""
        if self._way is None:
            return b""
        return protocol.END + protocol.command("set", self._command(u))

    def _begin(self) -> None:
        """Forget what has come so far."""
        self._replies, self._telnet = protocol.Replies(), protocol.Telnet()
        self._astray = False

    def _identify(self) -> None:
        """Ask for the name of the device; refuse another one."""
        self.identity = protocol.identity(self._ask(IDENTIFY, None))
        if not self.identity.startswith(MODEL):
            raise self._refusal(f"{self.identity[:40]!r} answers, not an {MODEL}; check it")

    def _fit(self) -> None:
        """Refuse a device that commands do not reach, or that moves by itself; open its loop."""
        self.check()
        if not int(self._value("stat")) & protocol.SENSOR:
            raise self._refusal("the actuator has no sensor, so meas tells no displacement")
        source = self._value("modsrc")
        if source != 0.0:
            raise self._refusal(
                f"modsrc is {source:g}, the voltage does not come from commands; "
                "send modsrc,0 when the stage may move"
            )
        self._ask(protocol.command("cl", 0.0), "")
        low, high = self._value("posmin"), self._value("posmax")
        if not low < high:
            raise self._refusal(f"a travel of {low:g} to {high:g}")
        self._sensor = self._sensor_over(low, high)
        reach = self._reach(self._value("avmin"), self._value("avmax"))
        self.limits = Limits(*reach, *self._sensor.image)

    def _held(self) -> float:
        """Voltage (V) that the device holds."""
        return self._amplifier.inverse(self._value("set"))

    def _line(self, u: float) -> bytes:
        """Line that sets u (V); the device will hold what the line says."""
        value = round(self._command(u), 3)
        self._u = self._amplifier.inverse(value)
        return protocol.command("set", value)

    def _value(self, name: str) -> float:
        return protocol.number(self._ask(protocol.command(name), name))

    def _recover(self) -> None:
        """After a failure: go on where the answers are those of now, and see what is held."""
        if self._astray:
            self._open().drop()
            self._begin()
            self._ask(IDENTIFY, None)
            self._u = self._held()

    def _ask(self, data: bytes, *names: str | None) -> protocol.Reply:
        """Send, and wait for replies of these names in turn; None: for the name of the device.

        Returns
        -------
        Reply
            The first of them.

        Raises
        ------
        DriverError
            No such replies in time, or the device refuses something.
        """
        astray, self._astray = self._astray, True
        self._send(data)
        way = self._open()
        end = time.monotonic() + way.timeout
        found: list[protocol.Reply] = []
        while True:
            left, answers = self._telnet.feed(way.receive())
            if answers:
                way.send(answers)
            for reply in self._replies.feed(left):
                refused = protocol.error(reply)
                if refused is not None:
                    asked = " ".join(data.decode("ascii").split())
                    raise self._wrong(f"{refused} to {asked!r}")
                if len(found) < len(names) and _is(reply, names[len(found)]):
                    found.append(reply)
            if len(found) == len(names):
                self._astray = astray
                return found[0]
            if time.monotonic() > end:
                raise transport.silent(self._params.address, way.timeout)

    def _send(self, data: bytes) -> None:
        self._open().send(data)


def _is(reply: protocol.Reply, name: str | None) -> bool:
    """Whether a reply has this name; for None whether it is the name of a device."""
    return reply.name == name if name is not None else bool(reply.name) and not reply.values


def make(plant: Any, T_s: float) -> Nv200:
    """Driver for the plant's parameters."""
    return Nv200(plant.driver, plant.voltage_min, plant.voltage_max)
