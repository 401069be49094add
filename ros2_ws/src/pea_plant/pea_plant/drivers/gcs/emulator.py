"""A PI controller that is none: GCS 2.0 in front of the simulated stage."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from pea_core.params import ParameterError, param
from pea_plant.drivers import emulator
from pea_plant.drivers.calibration import Curve
from pea_plant.drivers.emulator import Stage, Timing
from pea_plant.drivers.gcs import protocol


@dataclass(frozen=True)
class Params(Timing):
    """Emulated PI controller."""

    latency_s: float = param(5e-5, "s", 0.0, 10.0, help="from a request to its answer")
    identity: str = param(
        "(c) Physik Instrumente (PI) GmbH & Co. KG, E-727.1CD, 0, emulated",
        help="answer to *IDN?",
    )
    version: float = param(2.0, "", 1.0, 3.0, help="answer to CSV?")
    axes: str = param("1", help="answer to SAI?; the stage is on the first")
    command_min: float = param(-30.0, "V", -1e4, 1e4, help="lowest command, VMI?")
    command_max: float = param(130.0, "V", -1e4, 1e4, help="highest command, VMA?")
    travel_min: float = param(-10.0, "um", -1e6, 1e6, help="lowest position, TMN?")
    travel_max: float = param(25.0, "um", -1e6, 1e6, help="highest position, TMX?")
    servo: bool = param(False, help="the servo is on")
    tells_voltage: bool = param(True, help="knows VMI? and VMA?")

    def __post_init__(self) -> None:
        if not self.axes.split():
            raise ParameterError(f"axes = {self.axes!r}: give one axis at least")


class Axis:
    """What an axis without a stage remembers."""

    def __init__(self, servo: bool) -> None:
        self.servo = servo
        self.command = 0.0


class Emulator(emulator.Emulator):
    """Emulated PI controller; see `emulator.Emulator`."""

    def __init__(
        self, plant: Any, params: Params, port: int | None = 0, compiled: bool = False
    ) -> None:
        calibration = plant.driver.calibration
        self.params = params
        self.amplifier = Curve(
            "calibration.amplifier", calibration.amplifier, plant.voltage_min, plant.voltage_max
        )
        self.sensor = Curve(
            "calibration.sensor", calibration.sensor, params.travel_min, params.travel_max, 1e-6
        )
        ends = sorted(map(self.amplifier.inverse, (params.command_min, params.command_max)))
        self.axes = {name: Axis(params.servo) for name in params.axes.split()}
        self.error = 0
        stage = Stage(plant, ends[0], ends[1], params.update_s, compiled=compiled)
        super().__init__(stage, params, port)

    def session(self) -> Session:
        """A new connection; what it says acts on the one controller."""
        return Session(self)


class Session:
    """One connection.

    Parameters
    ----------
    controller : Emulator
    """

    def __init__(self, controller: Emulator) -> None:
        self._controller = controller
        self._rest = b""
        self._questions: dict[str, Callable[[str], str]] = {
            "POS?": self._position,
            "SVA?": lambda axis: f"{self._axis(axis).command:.6f}",
            "VOL?": lambda axis: f"{self._axis(axis).command:.6f}",
            "SVO?": lambda axis: str(int(self._axis(axis).servo)),
            "TMN?": lambda axis: f"{controller.params.travel_min:.6f}",
            "TMX?": lambda axis: f"{controller.params.travel_max:.6f}",
        }
        if controller.params.tells_voltage:
            self._questions |= {
                "VMI?": lambda axis: f"{controller.params.command_min:.6f}",
                "VMA?": lambda axis: f"{controller.params.command_max:.6f}",
            }

    def feed(self, data: bytes) -> bytes:
        """Take in bytes; the answers."""
        *lines, rest = (self._rest + data).split(b"\n")
        self._rest = rest[-protocol.LINE_MAX :]
        answer = ""
        for line in lines:
            words = line.decode(protocol.CODEC, "replace").split()
            try:
                if words:
                    answer += self._line(words[0].upper(), words[1:])
            except _Refused as error:
                self._controller.error = error.code
                self._controller.stage.felt.count(f"error {error.code}")
        return answer.encode(protocol.CODEC)

    def _line(self, word: str, rest: list[str]) -> str:
        controller = self._controller
        match word, rest:
            case "*IDN?", []:
                return f"{controller.params.identity}\n"
            case "CSV?", []:
                return f"{controller.params.version:.1f}\n"
            case "SAI?", [] | ["ALL"]:
                return " \n".join(controller.axes) + "\n"
            case "ERR?", []:
                code, controller.error = controller.error, 0
                return f"{code}\n"
            case question, axes if question in self._questions:
                ask = self._questions[question]
                asked = axes or list(controller.axes)
                return " \n".join(f"{axis}={ask(axis)}" for axis in asked) + "\n"
            case "SVO", [axis, "0" | "1" as on]:
                self._axis(axis).servo = on == "1"
            case "SVA", [axis, text]:
                self._command(axis, text)
            case "MOV", [axis, _]:
                raise _Refused(7 if self._axis(axis).servo else 5)
            case "STP", _:
                raise _Refused(10)
            case (("SVO" | "SVA" | "MOV" | "*IDN?" | "CSV?" | "SAI?" | "ERR?"), _):
                raise _Refused(1)
            case _:
                raise _Refused(2)
        return ""

    def _axis(self, name: str) -> Axis:
        if name not in self._controller.axes:
            raise _Refused(23)
        return self._controller.axes[name]

    def _command(self, name: str, text: str) -> None:
        controller, params = self._controller, self._controller.params
        axis = self._axis(name)
        try:
            command = float(text)
        except ValueError:
            raise _Refused(1) from None
        code = controller.faults.take("error")
        if code is not None:
            axis.servo |= code == 79.0
            raise _Refused(int(code))
        if axis.servo:
            raise _Refused(79)
        if not params.command_min <= command <= params.command_max:
            raise _Refused(17)
        axis.command = command
        if name == next(iter(controller.axes)):
            controller.stage.command(controller.amplifier.inverse(command))

    def _position(self, name: str) -> str:
        self._axis(name)
        controller = self._controller
        if name != next(iter(controller.axes)):
            return "0.000000"
        return f"{controller.sensor.inverse(controller.stage.reading()):.6f}"


class _Refused(Exception):
    def __init__(self, code: int) -> None:
        super().__init__(code)
        self.code = code


def make(plant: Any, params: Params, port: int | None = 0, compiled: bool = False) -> Emulator:
    """Emulator for a rig's plant; `port` None: a pty.

    Raises
    ------
    ParameterError
        The calibration is not monotone, or the port is taken.
    """
    return Emulator(plant, params, port, compiled)
