"""An NV200/D without hardware, on a pty or behind Telnet."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

from pea_core.params import param
from pea_drivers import emulator
from pea_drivers.calibration import CalibrationCurve
from pea_drivers.emulator import Timing
from pea_drivers.nv200 import protocol
from pea_drivers.stage import EmulatedStage

GREETING = bytes([protocol.IAC, protocol.WILL, 1, protocol.IAC, protocol.DO, 3])
"""What a Telnet server begins with: it will echo, and asks to suppress go-ahead."""

UNKNOWN, OUT_OF_RANGE, SURPLUS, LOCKED, LOW, HIGH = 2, 4, 5, 6, 9, 10
LOWER_LIMIT, UPPER_LIMIT, LOW_PASS, NOTCH = 1 << 14, 1 << 15, 1 << 4, 1 << 5
"""Bits of ``stat``: the loop is closed and at an end of its range; filters are on."""

SLEW_OFF = 2000.0
"""Slew rate (% of the range in a millisecond) that stands for none."""


class Setting(NamedTuple):
    """A parameter that can be set: its value at power-on, lowest and highest."""

    value: float
    low: float
    high: float
    whole: bool = False


SETTINGS = {
    "cl": Setting(0, 0, 1, True),
    "ctrlmode": Setting(0, 0, 3, True),
    "fenable": Setting(0, 0, 1, True),
    "kd": Setting(0.0, 0.0, 1e4),
    "ki": Setting(60.0, 0.0, 1e4),
    "kp": Setting(0.0, 0.0, 1e4),
    "modsrc": Setting(0, 0, 3, True),
    "monsrc": Setting(0, 0, 7, True),
    "notchb": Setting(100, 1, 1e4, True),
    "notchf": Setting(1000, 1, 1e4, True),
    "notchon": Setting(0, 0, 1, True),
    "poslpf": Setting(1000, 1, 1e4, True),
    "poslpon": Setting(0, 0, 1, True),
    "setlpf": Setting(1000, 1, 1e4, True),
    "setlpon": Setting(0, 0, 1, True),
    "sinit": Setting(0.0, 0.0, 100.0),
    "spisrc": Setting(0, 0, 9, True),
    "sr": Setting(SLEW_OFF, 8e-7, SLEW_OFF),
    "tf": Setting(0.0, 0.0, 1e4),
}
"""`cl`, `modsrc` and `sr` do what they do in the device; the others are kept and do nothing."""

PCF = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Params(Timing):
    """Emulated NV200/D, in its own units."""

    connections: int = param(
        1, "", 0, 1000, help="TCP connections that it takes at a time, 0: any number"
    )
    latency_s: float = param(3e-4, "s", 0.0, 10.0, help="from a command to its answer")
    baud: float = param(
        115200.0, "1/s", 0.0, 1e9, help="bits of the serial line, ten a byte; 0: no time"
    )
    identity: str = param("NV200/D_NET", help="answer to an empty command")
    status: int = param(3, "", 0, 65535, help="stat: actuator connected, strain gauge")
    closed_loop: bool = param(False, help="cl")
    modsrc: int = param(0, "", 0, 3, help="where the voltage comes from; 0: commands")
    actuator: str = param("EMULATED", help="desc")
    serial_number: str = param("000001", help="acserno")
    unit: str = param("um", help="unitcl")
    temperature: float = param(31.2, "deg C", -50.0, 200.0, help="temp")
    voltage_min: float = param(-20.0, "V", -1e4, 1e4, help="avmin")
    voltage_max: float = param(130.0, "V", -1e4, 1e4, help="avmax")
    position_min: float = param(-10.0, "", -1e9, 1e9, help="posmin")
    position_max: float = param(30.0, "", -1e9, 1e9, help="posmax")


def make(plant: object, params: Params, port: int | None = 0, compiled: bool = False) -> Emulator:
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
        See `pea_drivers.stage.EmulatedStage`.
    """

    timing: Params

    def __init__(
        self, plant: Any, params: Params, port: int | None = 0, compiled: bool = False
    ) -> None:
        known = plant.driver.calibration
        self.amplifier = CalibrationCurve(
            "calibration.amplifier", known.amplifier, plant.voltage_min, plant.voltage_max
        )
        self.sensor = CalibrationCurve(
            "calibration.sensor", known.sensor, params.position_min, params.position_max, 1e-6
        )
        ends = [self.amplifier.inverse(v) for v in (params.voltage_min, params.voltage_max)]
        self.heard = 0
        self.values = {name: one.value for name, one in SETTINGS.items()}
        self.values |= {"cl": int(params.closed_loop), "modsrc": params.modsrc}
        self.pcf: tuple[float, ...] = PCF
        stage = EmulatedStage(plant, min(ends), max(ends), params.update_s, compiled=compiled)
        self.held = self.amplifier(stage.u)
        super().__init__(stage, params, port)
        if params.closed_loop:
            self._close_loop()

    def session(self) -> Session:
        """A new connection."""
        return Session(self, telnet=self._listener is not None)

    @property
    def closed_loop(self) -> bool:
        """Whether `set` is a position, which the device's own servo holds."""
        return self.values["cl"] == 1

    def command(self, name: str, values: tuple[str, ...]) -> str:
        """Carry out a command; the text of its answer."""
        if not name:
            return f"{self.timing.identity}>"
        try:
            return self._set(name, values) if values else self._told(name)
        except _Refused as refused:
            self.stage.felt.count("refused_commands")
            return f"error,{refused.code}"

    def _told(self, name: str) -> str:
        """Answer to a reading."""
        timing = self.timing
        sensor = timing.status & protocol.SENSOR
        texts: dict[str, Callable[[], str]] = {
            "acmeasure": lambda: str(sensor >> 1),
            "acserno": lambda: timing.serial_number,
            "avmax": lambda: f"{timing.voltage_max:.3f}",
            "avmin": lambda: f"{timing.voltage_min:.3f}",
            "desc": lambda: timing.actuator,
            "meas": lambda: f"{self._position() if sensor else self._voltage():.3f}",
            "pcf": lambda: ",".join(f"{value:.3f}" for value in self.pcf),
            "posmax": lambda: f"{timing.position_max:.3f}",
            "posmin": lambda: f"{timing.position_min:.3f}",
            "set": lambda: f"{self.held:.3f}",
            "stat": lambda: str(self._stat()),
            "temp": lambda: f"{timing.temperature:.3f}",
            "unitcl": lambda: timing.unit,
            "unitol": lambda: "V",
        }
        if name in SETTINGS:
            value = self.values[name]
            return f"{name},{value:.0f}" if SETTINGS[name].whole else f"{name},{value:.7g}"
        if name not in texts:
            raise _Refused(UNKNOWN)
        return f"{name},{texts[name]()}"

    def _position(self) -> float:
        return self.sensor.inverse(self.stage.reading())

    def _voltage(self) -> float:
        return self.amplifier(self.stage.u)

    def _stat(self) -> int:
        values = self.values
        status = self.timing.status
        if self.closed_loop:
            status |= protocol.CLOSED_LOOP
            if self.stage.at_limit:
                status |= UPPER_LIMIT if self._voltage() > 0.0 else LOWER_LIMIT
        if values["setlpon"] or values["poslpon"]:
            status |= LOW_PASS
        return status | (NOTCH if values["notchon"] else 0)

    def _set(self, name: str, values: tuple[str, ...]) -> str:
        """Set a parameter: no answer."""
        if name == "set" and (code := self.faults.take("error")) is not None:
            raise _Refused(int(code))
        if name not in ("set", "pcf", *SETTINGS):
            self._told(name)  # is there such a one at all?
            raise _Refused(LOCKED)
        if len(values) > (3 if name == "pcf" else 1):
            raise _Refused(SURPLUS)
        if not all(protocol.is_number(text) for text in values):
            raise _Refused(OUT_OF_RANGE)
        numbers = tuple(map(float, values))
        if name == "set":
            self._setpoint(numbers[0])
        elif name == "pcf":
            self.pcf = numbers + self.pcf[len(numbers) :]
        else:
            _, low, high, whole = SETTINGS[name]
            _within(numbers[0], low, high)
            if whole and numbers[0] % 1.0:
                raise _Refused(OUT_OF_RANGE)
            self._change(name, numbers[0])
        return ""

    def _setpoint(self, value: float) -> None:
        """A voltage, or a position where the loop is closed.

        Where the device listens to another source it keeps the value until it listens again.
        """
        timing = self.timing
        if self.closed_loop:
            _within(value, timing.position_min, timing.position_max)
        else:
            _within(value, timing.voltage_min, timing.voltage_max)
        self.held = value
        if self.values["modsrc"] == 0:
            self._apply()

    def _apply(self) -> None:
        if self.closed_loop:
            self.stage.target = self.sensor(self.held)
        else:
            self.stage.command(self.amplifier.inverse(self.held))

    def _change(self, name: str, value: float) -> None:
        """Take a new value of a parameter, and do what it means."""
        before, self.values[name] = self.values[name], value
        if name == "cl" and value != before:
            if value:
                self._close_loop()
            else:
                self.stage.target = None
                self.held = self._voltage()
        elif name == "modsrc" and value == 0 and before != 0:
            self._apply()
        elif name == "sr":
            per_ms = (self.stage.voltage_max - self.stage.voltage_min) * value / 100.0
            self.stage.slew(math.inf if value >= SLEW_OFF else per_ms * 1e3)

    def _close_loop(self) -> None:
        """Hold the position where the stage is; nothing jumps."""
        position = self._position()
        self.held = min(max(position, self.timing.position_min), self.timing.position_max)
        self.stage.target = self.sensor(self.held)
        self.ticks()

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


class _Refused(Exception):
    def __init__(self, code: int) -> None:
        super().__init__(code)
        self.code = code


def _within(value: float, low: float, high: float) -> None:
    if not value >= low:
        raise _Refused(LOW)
    if not value <= high:
        raise _Refused(HIGH)
