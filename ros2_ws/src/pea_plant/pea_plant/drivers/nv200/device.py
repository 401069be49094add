"""An NV200/D in volts and metres."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import Any

from pea_core.params import ParameterError, group, param
from pea_core.signals import Measurement
from pea_plant.drivers import calibration, transport
from pea_plant.drivers.calibration import Curve
from pea_plant.drivers.driver import DriverError, Limits, refusing, within
from pea_plant.drivers.nv200 import protocol

MODEL = "NV200"
"""How the name of the device starts."""

MEASURE = protocol.command("meas")
IDENTIFY = protocol.END


@dataclass(frozen=True)
class Params:
    """NV200/D of piezosystem jena, over a serial line or Telnet, one channel."""

    address: str = param(
        "serial:/dev/ttyUSB0", help="serial:/dev/NAME, or tcp://HOST:23 for Telnet", fixed=True
    )
    timeout_s: float = param(0.1, "s", 1e-3, 60.0, help="longest wait for an answer", fixed=True)
    pipelined: bool = param(
        True, help="meas and set in one write; false: set when the device is ready", fixed=True
    )
    calibration: calibration.Params = group(calibration.Params)

    def __post_init__(self) -> None:
        _, _, options = transport.parse(self.address)
        if options.get("xonxoff"):
            raise ParameterError(
                f"address = {self.address!r}: XON and XOFF frame the answers; leave xonxoff out"
            )


class Nv200:
    """Driver of an NV200/D.

    Parameters
    ----------
    params : Params
    voltage_min, voltage_max : float
        Range that the plant asks for (V).

    Raises
    ------
    ParameterError
        The calibration is not monotone over that range.
    """

    limits: Limits
    identity: str

    def __init__(self, params: Params, voltage_min: float, voltage_max: float) -> None:
        self._params = params
        self._range = voltage_min, voltage_max
        self._amplifier = Curve("calibration.amplifier", params.calibration.amplifier, *self._range)
        self._way: transport.Transport | None = None
        self._u = 0.0
        self._astray = False

    def connect(self) -> None:
        """Identify the device, refuse one that is not ready, open its loop, read its limits."""
        self.close()
        with refusing(self.close):
            self._way = transport.connect(self._params.address, self._params.timeout_s)
            self._begin()
            self._astray = False
            self._identify()
            self._refuse_unready()
            self._ask(protocol.command("cl", 0.0), "")
            self._read_limits()
            self._u = self._held()
            self.read()

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

    def fileno(self) -> int:
        """File descriptor of the connection."""
        return -1 if self._way is None else self._way.fileno()

    def close(self) -> None:
        """Close the connection; the device holds its voltage."""
        if self._way is not None:
            self._way.close()
            self._way = None

    def _begin(self) -> None:
        """Forget what has come so far."""
        self._replies, self._telnet = protocol.Replies(), protocol.Telnet()

    def _identify(self) -> None:
        """Ask for the name of the device; refuse another one."""
        try:
            self.identity = protocol.identity(self._ask(IDENTIFY, None))
        except DriverError as error:
            raise self._refusal(f"no {MODEL} answers ({error})") from None
        if not self.identity.startswith(MODEL):
            raise self._refusal(f"{self.identity[:40]!r} answers, not an {MODEL}; check it")

    def _refuse_unready(self) -> None:
        """Refuse a device that commands do not reach, or that moves by itself."""
        self.check()
        if not int(self._value("stat")) & protocol.SENSOR:
            raise self._refusal("the actuator has no sensor, so meas tells no displacement")
        source = self._value("modsrc")
        if source != 0.0:
            raise self._refusal(
                f"modsrc is {source:g}, the voltage does not come from commands; "
                "send modsrc,0 when the stage may move"
            )

    def _read_limits(self) -> None:
        low, high = self._value("posmin"), self._value("posmax")
        if not low < high:
            raise self._refusal(f"a travel of {low:g} to {high:g}")
        self._sensor = Curve(
            "calibration.sensor", self._params.calibration.sensor, low, high, scale=1e-6
        )
        reach = sorted(self._amplifier.inverse(self._value(name)) for name in ("avmin", "avmax"))
        self.limits = Limits(reach[0], reach[1], *self._sensor.image)
        try:
            within(self.limits, *self._range, self.identity)
        except ParameterError as error:
            raise DriverError(str(error)) from None  # of the plant, not of the driver

    def _held(self) -> float:
        """Voltage (V) that the device holds."""
        return self._amplifier.inverse(self._value("set"))

    def _line(self, u: float) -> bytes:
        """Line that sets u (V); the device will hold what the line says."""
        value = round(self._command(u), 3)
        self._u = self._amplifier.inverse(value)
        return protocol.command("set", value)

    def _command(self, u: float) -> float:
        """What the device is to be told for u (V)."""
        low, high = self._range
        if not low <= u <= high:
            raise DriverError(f"voltage {u}: must be within {low:g} to {high:g} V")
        return self._amplifier(u)

    def _value(self, name: str) -> float:
        return protocol.number(self._ask(protocol.command(name), name))

    def _recover(self) -> None:
        """After a failure: go on where the answers are those of now, and see what is held."""
        if self._astray:
            assert self._way is not None
            self._begin()
            self._way.drop()
            self._ask(IDENTIFY, None)
            self._u = self._held()
            self._astray = False

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
        assert self._way is not None
        end = time.monotonic() + self._params.timeout_s
        found: list[protocol.Reply] = []
        while True:
            left, answers = self._telnet.feed(self._way.receive())
            if answers:
                self._way.send(answers)
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
                raise transport.silent(self._params.address, self._params.timeout_s)

    def _send(self, data: bytes) -> None:
        if self._way is None:
            raise self._wrong("not connected; connect first")
        self._way.send(data)

    def _wrong(self, what: str) -> DriverError:
        return DriverError(f"{self._params.address}: {what}")

    def _refusal(self, what: str) -> ParameterError:
        return ParameterError(f"address = {self._params.address!r}: {what}")


def _is(reply: protocol.Reply, name: str | None) -> bool:
    """Whether a reply has this name; for None whether it is the name of a device."""
    return reply.name == name if name is not None else bool(reply.name) and not reply.values


def make(plant: Any, T_s: float) -> Nv200:
    """Driver for the plant's parameters."""
    return Nv200(plant.driver, plant.voltage_min, plant.voltage_max)
