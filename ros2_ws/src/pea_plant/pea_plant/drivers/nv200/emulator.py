"""An NV200/D without hardware, on a pty or behind Telnet."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from pea_core.params import param
from pea_plant.drivers import emulator
from pea_plant.drivers.calibration import Curve
from pea_plant.drivers.emulator import Stage, Timing
from pea_plant.drivers.nv200 import protocol

GREETING = bytes([protocol.IAC, protocol.WILL, 1, protocol.IAC, protocol.DO, 3])
"""What a Telnet server begins with: it will echo, and asks to suppress go-ahead."""

UNKNOWN, OUT_OF_RANGE, SURPLUS, LOCKED, LOW, HIGH = 2, 4, 5, 6, 9, 10


@dataclass(frozen=True)
class Params(Timing):
    """Emulated NV200/D, in its own units."""

    latency_s: float = param(3e-4, "s", 0.0, 10.0, help="from a command to its answer")
    baud: float = param(
        115200.0, "1/s", 0.0, 1e9, help="bits of the serial line, ten a byte; 0: no time"
    )
    identity: str = param("NV200/D_NET", help="answer to an empty command")
    status: int = param(3, "", 0, 65535, help="stat: actuator connected, strain gauge")
    closed_loop: bool = param(False, help="cl")
    modsrc: int = param(0, "", 0, 3, help="where the voltage comes from; 0: commands")
    voltage_min: float = param(-20.0, "V", -1e4, 1e4, help="avmin")
    voltage_max: float = param(130.0, "V", -1e4, 1e4, help="avmax")
    position_min: float = param(-10.0, "", -1e9, 1e9, help="posmin")
    position_max: float = param(30.0, "", -1e9, 1e9, help="posmax")


def make(plant: Any, params: Params, port: int | None = 0, compiled: bool = False) -> Emulator:
    """Emulator of the device that the plant's parameters drive."""
    return Emulator(plant, params, port, compiled)


class Emulator(emulator.Emulator):
    """An NV200/D with the simulated actuator.

    Parameters
    ----------
    plant : pea_plant.plant.Params
        With an `nv200` driver: the device's units are those of its calibration.
    params : Params
    port : int
        TCP port for Telnet, 0 for any; None for a pty.
    compiled : bool
        See `pea_plant.drivers.emulator.Stage`.
    """

    timing: Params

    def __init__(
        self, plant: Any, params: Params, port: int | None = 0, compiled: bool = False
    ) -> None:
        known = plant.driver.calibration
        self.amplifier = Curve(
            "calibration.amplifier", known.amplifier, plant.voltage_min, plant.voltage_max
        )
        self.sensor = Curve(
            "calibration.sensor", known.sensor, params.position_min, params.position_max, 1e-6
        )
        ends = [self.amplifier.inverse(v) for v in (params.voltage_min, params.voltage_max)]
        self.heard = 0
        self.closed_loop, self.modsrc = int(params.closed_loop), params.modsrc
        stage = Stage(plant, min(ends), max(ends), params.update_s, compiled=compiled)
        self.held = self.amplifier(stage.u)
        super().__init__(stage, params, port)

    def session(self) -> Session:
        """A new connection."""
        return Session(self, telnet=self._listener is not None)

    def command(self, name: str, values: tuple[str, ...]) -> str:
        """Carry out a command; the text of its answer."""
        if not name:
            return f"{self.timing.identity}>"
        if name == "set" and values:
            return self._set(values)
        if name == "cl" and values:
            self.closed_loop = int(values[0].startswith("1"))
            return ""
        readings: dict[str, Callable[[], float]] = {
            "set": lambda: self.held,
            "meas": lambda: self.sensor.inverse(self.stage.reading()),
            "cl": lambda: self.closed_loop,
            "modsrc": lambda: self.modsrc,
            "stat": self._stat,
            "avmin": lambda: self.timing.voltage_min,
            "avmax": lambda: self.timing.voltage_max,
            "posmin": lambda: self.timing.position_min,
            "posmax": lambda: self.timing.position_max,
        }
        if name not in readings:
            return self._refuse(UNKNOWN)
        if values:
            return self._refuse(LOCKED)
        value = readings[name]()
        return f"{name},{value}" if isinstance(value, int) else f"{name},{value:.3f}"

    def _stat(self) -> int:
        return self.timing.status | (protocol.CLOSED_LOOP if self.closed_loop else 0)

    def _set(self, values: tuple[str, ...]) -> str:
        if (code := self.faults.take("error")) is not None:
            return self._refuse(int(code))
        if len(values) > 1:
            return self._refuse(SURPLUS)
        try:
            value = float(values[0])
        except ValueError:
            return self._refuse(OUT_OF_RANGE)
        if self.closed_loop or self.modsrc:
            return self._refuse(LOCKED)
        if not value >= self.timing.voltage_min:
            return self._refuse(LOW)
        if not value <= self.timing.voltage_max:
            return self._refuse(HIGH)
        self.held = value
        self.stage.command(self.amplifier.inverse(value))
        return ""

    def _refuse(self, code: int) -> str:
        self.stage.felt.count("refused_commands")
        return f"error,{code}"

    def _answer(self, way: Any, answer: bytes, t: float) -> None:
        size = 10.0 * (self.heard + len(answer))
        super()._answer(way, answer, t + (size / self.timing.baud if self.timing.baud else 0.0))


class Session:
    """One connection to the device."""

    def __init__(self, device: Emulator, telnet: bool) -> None:
        self._device = device
        self._commands = protocol.Commands()
        self._telnet = protocol.Telnet() if telnet else None
        self._greeting = GREETING if telnet else b""

    def feed(self, data: bytes) -> bytes:
        """Take in bytes; the frames that answer them."""
        device = self._device
        device.heard = len(data)
        if self._telnet is not None:
            data, _ = self._telnet.feed(data)
        frames = bytearray()
        for name, *values in self._commands.feed(data):
            text = device.command(name, tuple(values))
            frames += bytes([protocol.XOFF]) + text.encode("latin-1")
            frames += (protocol.END if text else b"") + bytes([protocol.XON])
        if frames:
            frames[:0], self._greeting = self._greeting, b""
        return bytes(frames)
