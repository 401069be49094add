"""An NV200/D in volts and metres."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from pea_core.params import ParameterError, param
from pea_core.signals import Measurement
from pea_drivers import device, transport
from pea_drivers.nv200 import protocol
from pea_plant.drivers.driver import Limits
from pea_watchdog.client import Question

MODEL = "NV200"
"""How the name of the device starts."""

MEASURE = protocol.command("meas")
IDENTIFY = protocol.END

HUSH = 0.01
"""Silence after which the replies to a command of the last resort have come (s)."""


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
    PADDING = protocol.PADDING

    def _exchange(self, u: float) -> Measurement:
        """Measure and set u (V), in one write.

        In this order: on a serial line the second command comes half a millisecond later, in
        which a stage has moved.
        """
        applied, line = self._u, self._line(u)
        if self._params.pipelined:
            reply = self._ask(MEASURE + line, "meas", "")
        else:
            reply = self._ask(MEASURE, "meas")
            self._ask(line, "")
        return Measurement(self._sensor(protocol.number(reply)), math.nan, applied)

    def _read(self) -> Measurement:
        y = self._sensor(protocol.number(self._ask(MEASURE, "meas")))
        return Measurement(y, math.nan, self._u)

    def _write(self, u: float) -> None:
        self._astray = True  # its reply is not waited for
        self._open().send(self._line(u))

    def _check(self) -> None:
        """Read the status register."""
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
        self._astray = True  # if it is sent, replies come that nobody waits for
        return protocol.END + protocol.command("set", self._command(u))

    def question(self) -> Question:
        """How to ask what is held."""
        data = protocol.END + protocol.command("set")
        return Question(data, rb"set,([-+\d.eE]+)\s", "", self._command)

    def _begin(self) -> None:
        """Forget what has come so far."""
        self._replies, self._telnet = protocol.Replies(), protocol.Telnet()

    def _recover(self) -> None:
        """See that the next reply belongs to the next question."""
        self._skip_to(IDENTIFY, self._mark, HUSH)

    def _identify(self) -> None:
        """Ask for the name of the device; refuse another one."""
        reply = self._ask(IDENTIFY, None)
        self.identity = protocol.identity(reply)
        if not self.identity.startswith(MODEL):
            raise self._refusal(f"{self.identity[:40]!r} answers, not an {MODEL}; check it")
        self._mark = protocol.framed(reply)

    def _fit(self) -> None:
        """Refuse a device that commands do not reach, or that moves by itself; open its loop."""
        self._check()
        if not int(self._value("stat")) & protocol.SENSOR:
            raise self._refusal("the actuator has no sensor, so meas returns no displacement")
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

    def _ask(self, data: bytes, *names: str | None) -> protocol.Reply:
        """Send, and wait for replies of these names in turn.

        None stands for the name of the device, whatever comes before it: a Telnet server may have
        greeted.

        Returns
        -------
        Reply
            The first of them.

        Raises
        ------
        DriverError
            No such replies in time, or the device refuses something.
        """
        found: list[protocol.Reply] = []

        def take(piece: bytes) -> protocol.Reply | None:
            left, options = self._telnet.feed(piece)
            if options:
                self._open().send(options)
            for reply in self._replies.feed(left):
                refused = protocol.error(reply)
                if refused is not None:
                    asked = " ".join(data.decode("ascii").split())
                    raise self._wrong(f"{refused} to {asked!r}")
                name = names[len(found)] if len(found) < len(names) else ""
                if len(found) < len(names) and _is(reply, name):
                    found.append(reply)
                elif name is not None:
                    raise self._unasked(str(reply).encode())
            if len(found) < len(names):
                return None
            if self._replies.begun:
                raise self._unasked(piece)
            return found[0]

        return self._talk(data, take)


def _is(reply: protocol.Reply, name: str | None) -> bool:
    """Whether a reply has this name; for None whether it is the name of a device."""
    return reply.name == name if name is not None else bool(reply.name) and not reply.values


def make(plant: Any, T_s: float) -> Nv200:
    """Driver for the plant's parameters."""
    return Nv200(plant.driver, plant.voltage_min, plant.voltage_max)
