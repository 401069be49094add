"""A PI controller that is none: GCS 2.0 in front of the simulated stage."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from pea_core.params import ParameterError, param
from pea_drivers import emulator
from pea_drivers.calibration import CalibrationCurve
from pea_drivers.emulator import Timing
from pea_drivers.gcs import protocol
from pea_drivers.stage import EmulatedStage, couple


@dataclass(frozen=True)
class Params(Timing):
    """Emulated PI controller."""

    connections: int = param(
        1, "", 0, 1000, help="TCP connections that it takes at a time, 0: any number"
    )
    latency_s: float = param(5e-5, "s", 0.0, 10.0, help="from a request to its answer")
    identity: str = param(
        "(c) Physik Instrumente (PI) GmbH & Co. KG, E-727.1CD, 0, emulated",
        help="answer to *IDN?",
    )
    version: float = param(2.0, "", 1.0, 3.0, help="answer to CSV?")
    axes: str = param("1", help="answer to SAI?; the stage is on the first")
    stages: int = param(1, "", 1, 6, help="how many of the axes, from the first on, have a stage")
    command_min: float = param(-30.0, "V", -1e4, 1e4, help="lowest command, VMI?")
    command_max: float = param(130.0, "V", -1e4, 1e4, help="highest command, VMA?")
    travel_min: float = param(-10.0, "um", -1e6, 1e6, help="lowest position, TMN?")
    travel_max: float = param(25.0, "um", -1e6, 1e6, help="highest position, TMX?")
    servo: bool = param(False, help="the servo is on at power-on")
    tells_voltage: bool = param(True, help="knows VMI? and VMA?")

    def __post_init__(self) -> None:
        if not self.axes.split():
            raise ParameterError(f"axes = {self.axes!r}: give one axis at least")
        if self.stages > len(self.axes.split()):
            raise ParameterError(
                f"stages = {self.stages}: the controller has the axes {self.axes!r} only"
            )


LINE_MAX = 256
"""Characters of a line that the controller takes."""

UNKNOWN, TOO_LONG, NO_SERVO, OUT_OF_LIMITS, STOPPED, OUT_OF_RANGE = 2, 3, 5, 7, 10, 17
SYNTAX, ILLEGAL_AXIS, NO_PARAMETER, READ_ONLY, NO_DATA, SERVO_ON = 1, 23, 54, 64, 77, 79

MOTION, IS_READY, STOP = b"\x05", b"\x07", b"\x18"
SINGLE = re.compile(b"([\x05\x07\x18])")
"""Requests of one byte: they need no end of a line, and leave a line that has begun alone."""

NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")


class Axis:
    """What an axis remembers."""

    def __init__(self) -> None:
        self.servo = False
        self.command = self.target = 0.0


class Emulator(emulator.Emulator):
    """Emulated PI controller; see `emulator.Emulator`.

    `plant` may be a tuple of them, one for each axis of a loop: the stage of an axis is that of the
    plant with its ``driver.axis``, and ``stage.cross_talk`` counts.
    """

    def __init__(
        self, plant: Any, params: Params, port: int | None = 0, compiled: bool = False
    ) -> None:
        several = plant if type(plant) is tuple else (plant,)
        by_name, plant = {one.driver.axis: one for one in several}, several[0]
        calibration = plant.driver.calibration
        self.params = params
        self.amplifier = CalibrationCurve(
            "calibration.amplifier", calibration.amplifier, plant.voltage_min, plant.voltage_max
        )
        self.sensor = CalibrationCurve(
            "calibration.sensor", calibration.sensor, params.travel_min, params.travel_max, 1e-6
        )
        ends = sorted(map(self.amplifier.inverse, (params.command_min, params.command_max)))
        self.axes = {name: Axis() for name in params.axes.split()}
        self.error = 0
        self.stages = {
            name: EmulatedStage(
                by_name.get(name, plant), ends[0], ends[1], params.update_s, compiled=compiled
            )
            for name in list(self.axes)[: params.stages]
        }
        if shares := plant.stage.cross_talk:
            if missing := by_name.keys() - self.stages.keys():
                raise ParameterError(
                    f"stage.cross_talk: the channel {min(missing)!r} has no stage behind it; give "
                    "emulator.stages and emulator.axes for all"
                )
            couple([self.stages[name] for name in by_name], shares)
        super().__init__(next(iter(self.stages.values())), params, port)
        if params.servo:
            for name in self.axes:
                self.switch(name, True)

    def session(self) -> Session:
        """A new connection; what it says acts on the one controller."""
        return Session(self)

    def has_stage(self, name: str) -> bool:
        """Whether an axis has a stage."""
        return name in self.stages

    def every_stage(self) -> dict[str, EmulatedStage]:
        """The stage of each axis that has one."""
        return self.stages

    def position(self, name: str) -> float:
        """Position of an axis (um); without a stage it is where it was sent."""
        if self.has_stage(name):
            return self.sensor.inverse(self.stages[name].reading())
        return self.axes[name].target if self.axes[name].servo else 0.0

    def voltage(self, name: str) -> float:
        """Command that an axis holds (V), whoever has given it."""
        if self.has_stage(name) and self.axes[name].servo:
            return self.amplifier(self.stages[name].u)
        return self.axes[name].command

    def switch(self, name: str, on: bool) -> None:
        """Switch the servo of an axis; nothing jumps."""
        axis = self.axes[name]
        if axis.servo and not on:
            axis.command = self.voltage(name)
        if on and not axis.servo:
            self.move(name, self.position(name))
        if not on and self.has_stage(name):
            self.stages[name].target = None
        axis.servo = on

    def move(self, name: str, target: float) -> None:
        """Send an axis to a position (um), by its servo."""
        self.axes[name].target = target
        if self.has_stage(name):
            self.stages[name].target = self.sensor(target)
            self.ticks()

    def drive(self, name: str, command: float) -> None:
        """Command a voltage (V)."""
        self.axes[name].command = command
        if self.has_stage(name):
            self.stages[name].command(self.amplifier.inverse(command))

    def on_target(self, name: str) -> bool:
        """Whether the servo has brought an axis to its target."""
        return self.stages[name].on_target if self.has_stage(name) else self.axes[name].servo

    def stop(self, names: Iterable[str]) -> None:
        """Stop axes where they are; the controller tells it as an error."""
        for name in names:
            if self.axes[name].servo:
                self.move(name, self.position(name))
        self.error = STOPPED


class Session:
    """One connection.

    Parameters
    ----------
    controller : Emulator
    """

    def __init__(self, controller: Emulator) -> None:
        self._controller = controller
        self._rest = b""
        params = controller.params
        fixed = {"TMN?": params.travel_min, "TMX?": params.travel_max}
        if params.tells_voltage:
            fixed |= {"VMI?": params.command_min, "VMA?": params.command_max}
        self._of_axis: dict[str, Callable[[str], str]] = {
            "CST?": lambda axis: "EMULATED" if controller.has_stage(axis) else "NOSTAGE",
            "MOV?": lambda axis: f"{controller.axes[axis].target:.6f}",
            "ONT?": lambda axis: str(int(controller.on_target(axis))),
            "OVF?": lambda axis: str(
                int(controller.has_stage(axis) and controller.stages[axis].at_limit)
            ),
            "POS?": lambda axis: f"{controller.position(axis):.6f}",
            "PUN?": lambda axis: "um",
            "SVA?": lambda axis: f"{controller.voltage(axis):.6f}",
            "SVO?": lambda axis: str(int(controller.axes[axis].servo)),
            "VOL?": lambda axis: f"{controller.voltage(axis):.6f}",
        }
        for name, value in fixed.items():
            self._of_axis[name] = lambda axis, told=f"{value:.6f}": told  # type: ignore[misc]
        self._of_controller: dict[str, Callable[[list[str]], list[str]]] = {
            "*IDN?": lambda words: [params.identity],
            "CSV?": lambda words: [f"{params.version:.1f}"],
            "DRR?": self._recorded,
            "ERR?": self._error,
            "HLP?": self._help,
            "HPA?": self._parameters,
            "SAI?": lambda words: list(controller.axes),
            "SPA?": self._values,
            "VER?": lambda words: ["FW_EMULATOR: V1.0"],
        }
        self._commands: dict[str, Callable[[list[str]], None]] = {
            "HLT": lambda words: controller.stop(self._axes(words)),
            "MOV": lambda words: self._move(words, False),
            "MVR": lambda words: self._move(words, True),
            "SPA": self._set_parameter,
            "STP": lambda words: controller.stop(controller.axes),
            "SVA": lambda words: self._drive(words, False),
            "SVO": self._switch,
            "SVR": lambda words: self._drive(words, True),
        }

    def feed(self, data: bytes) -> bytes:
        """Take in bytes; the answers."""
        answer = b""
        for piece in SINGLE.split(data):
            if SINGLE.fullmatch(piece):
                answer += self._single(piece)
                continue
            *lines, self._rest = (self._rest + piece).split(b"\n")
            for line in lines:
                answer += self._line(line)
            self._rest = self._rest[: LINE_MAX + 1]  # what is longer is refused whole, at its end
        return answer

    def _single(self, byte: bytes) -> bytes:
        """Answer to a request of one byte."""
        controller = self._controller
        if byte == IS_READY:
            return b"\xb1\n"
        if byte == STOP:
            controller.stop(controller.axes)
            return b""
        moving = (
            axis.servo and not controller.on_target(name) for name, axis in controller.axes.items()
        )
        return b"%X\n" % sum(on << i for i, on in enumerate(moving))

    def _line(self, line: bytes) -> bytes:
        """Answer to a line; what is refused has none, and is the error from now on."""
        codec = protocol.ASCII if line.isascii() else protocol.CODEC
        word, *words = line.decode(codec, "replace").split() or [""]
        try:
            if len(line) > LINE_MAX:
                raise _Refused(TOO_LONG)
            answer = self._answer(word.upper(), words) if word else []
        except _Refused as error:
            self._controller.error = error.code
            self._controller.stage.felt.count(f"error {error.code}")
            answer = []
        return " \n".join(answer).encode(protocol.CODEC) + b"\n" if answer else b""

    def _answer(self, name: str, words: list[str]) -> list[str]:
        """Lines of the answer to a question, none to a command."""
        if name in self._commands:
            self._commands[name](words)
            return []
        if name in self._of_axis:
            ask = self._of_axis[name]
            return [f"{axis}={ask(axis)}" for axis in self._axes(words)]
        if name not in self._of_controller:
            raise _Refused(UNKNOWN)
        if words and name not in ("DRR?", "SPA?") and (name, words) != ("SAI?", ["ALL"]):
            raise _Refused(SYNTAX)
        return self._of_controller[name](words)

    def _axes(self, names: list[str]) -> list[str]:
        """Axes of these names; default: all."""
        if not set(names) <= set(self._controller.axes):
            raise _Refused(ILLEGAL_AXIS)
        return names or list(self._controller.axes)

    def _pairs(self, words: list[str]) -> list[tuple[str, float]]:
        """Axes and numbers, one after the other."""
        if not words or len(words) % 2:
            raise _Refused(SYNTAX)
        if not all(map(NUMBER.fullmatch, words[1::2])):
            raise _Refused(SYNTAX)
        return list(zip(self._axes(words[::2]), map(float, words[1::2]), strict=True))

    def _error(self, words: list[str]) -> list[str]:
        code, self._controller.error = self._controller.error, 0
        return [str(code)]

    def _switch(self, words: list[str]) -> None:
        pairs = self._pairs(words)
        if not all(on in (0.0, 1.0) for _, on in pairs):
            raise _Refused(SYNTAX)
        for name, on in pairs:
            self._controller.switch(name, on == 1.0)

    def _drive(self, words: list[str], relative: bool) -> None:
        """Command voltages: all of a line or, where one is refused, none."""
        controller, params = self._controller, self._controller.params
        pairs = self._pairs(words)
        code = controller.faults.take("error")
        if code is not None:
            if code == SERVO_ON:
                controller.switch(pairs[0][0], True)
            raise _Refused(int(code))
        if any(controller.axes[name].servo for name, _ in pairs):
            raise _Refused(SERVO_ON)
        if relative:
            pairs = [(name, controller.voltage(name) + by) for name, by in pairs]
        if not all(params.command_min <= command <= params.command_max for _, command in pairs):
            raise _Refused(OUT_OF_RANGE)
        for name, command in pairs:
            controller.drive(name, command)

    def _move(self, words: list[str], relative: bool) -> None:
        """Send axes to positions by their servos: all of a line, or none."""
        controller, params = self._controller, self._controller.params
        pairs = self._pairs(words)
        if not all(controller.axes[name].servo for name, _ in pairs):
            raise _Refused(NO_SERVO)
        if relative:
            pairs = [(name, controller.axes[name].target + by) for name, by in pairs]
        if not all(params.travel_min <= target <= params.travel_max for _, target in pairs):
            raise _Refused(OUT_OF_LIMITS)
        for name, target in pairs:
            controller.move(name, target)

    def _known(self) -> dict[int, tuple[str, str, str]]:
        """Parameters of an axis: value, type, name."""
        params = self._controller.params
        return {
            0x3C: ("EMULATED", "CHAR", "Stage Name"),
            0x07000000: (f"{params.travel_min:.6f}", "FLOAT", "Range Limit min"),
            0x07000001: (f"{params.travel_max:.6f}", "FLOAT", "Range Limit max"),
            0x07000601: ("um", "CHAR", "Axis Unit"),
            0x0C000000: (f"{params.command_min:.6f}", "FLOAT", "Voltage Limit low"),
            0x0C000001: (f"{params.command_max:.6f}", "FLOAT", "Voltage Limit high"),
        }

    def _values(self, words: list[str]) -> list[str]:
        """Answer to ``SPA?``, of all axes and parameters or of pairs of them."""
        known = self._known()
        if words:
            asked = [(axis, self._number(text, known)) for axis, text in self._by_two(words)]
        else:
            asked = [(axis, number) for axis in self._controller.axes for number in known]
        return [f"{axis} 0x{number:08X}={known[number][0]}" for axis, number in asked]

    def _by_two(self, words: list[str]) -> list[tuple[str, str]]:
        if len(words) % 2:
            raise _Refused(SYNTAX)
        return list(zip(self._axes(words[::2]), words[1::2], strict=True))

    @staticmethod
    def _number(text: str, known: dict[int, Any]) -> int:
        """Number of a parameter."""
        try:
            number = int(text, 0)
        except ValueError:
            raise _Refused(SYNTAX) from None
        if number not in known:
            raise _Refused(NO_PARAMETER)
        return number

    def _set_parameter(self, words: list[str]) -> None:
        """No parameter can be set here: what depends on it would not follow."""
        if not words or len(words) % 3:
            raise _Refused(SYNTAX)
        self._axes(words[::3])
        for text in words[1::3]:
            self._number(text, self._known())
        raise _Refused(READ_ONLY)

    def _parameters(self, words: list[str]) -> list[str]:
        lines = [
            f"0x{number:X}=\t0\t1\t{kind}\temulator\t{name}"
            for number, (_, kind, name) in self._known().items()
        ]
        return ["The following parameters are valid:", *lines, "end of help"]

    def _help(self, words: list[str]) -> list[str]:
        questions = sorted({*self._of_axis, *self._of_controller, *self._commands})
        singles = ["#5 Request Motion Status", "#7 Request Controller Ready", "#24 Stop All Axes"]
        return ["The following commands are valid:", *singles, *questions, "end of help"]

    def _recorded(self, words: list[str]) -> list[str]:
        """The data recorder is never started here, so it has nothing."""
        raise _Refused(NO_DATA)


class _Refused(Exception):
    def __init__(self, code: int) -> None:
        super().__init__(code)
        self.code = code


def make(plant: object, params: Params, port: int | None = 0, compiled: bool = False) -> Emulator:
    """Emulator for a rig's plant; `port` None: a pty.

    Raises
    ------
    ParameterError
        The calibration is not monotone, or the port is taken.
    """
    return Emulator(plant, params, port, compiled)
