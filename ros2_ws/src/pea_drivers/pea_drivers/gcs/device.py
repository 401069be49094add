"""A PI controller in volts and metres.

One cycle is one write, ``SVA axis command`` and ``POS? axis``, and one answer. Answers come in
the order of the questions and do not say to which they belong, so after a failure the driver asks
``*IDN?``, whose answer it knows, and throws away all that comes before.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from pea_core.params import ParameterError, param
from pea_core.signals import Measurement
from pea_drivers import device
from pea_drivers.gcs import protocol
from pea_plant.drivers.driver import Limits, within
from pea_watchdog.client import Question

MAKER = "Physik Instrumente"
IDENTIFY = "*IDN?"


@dataclass(frozen=True)
class Params(device.Params):
    """PI controller by the General Command Set 2.0, over TCP or a serial line."""

    device: str = param("", help="part of the answer to *IDN?; empty: any of PI", fixed=True)
    axis: str = param("1", help="axis of the controller", fixed=True)
    command_min: float = param(
        0.0,
        "V",
        -1e4,
        1e4,
        help="lowest command, where the controller does not report it",
        fixed=True,
    )
    command_max: float = param(
        0.0,
        "V",
        -1e4,
        1e4,
        help="highest command; equal to the lowest: the controller must report both",
        fixed=True,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.axis or not self.axis.isprintable() or " " in self.axis:
            raise ParameterError(f"axis = {self.axis!r}: give one word, as SAI? reports it")
        if self.command_min > self.command_max:
            raise ParameterError(
                f"command_min = {self.command_min:g}: must not be above command_max "
                f"({self.command_max:g} V)"
            )


class Gcs(device.Device):
    """Driver of one axis of a PI controller; see `device.Device`."""

    NAME = "PI controller"

    def __init__(self, params: Params, voltage_min: float, voltage_max: float) -> None:
        super().__init__(params, voltage_min, voltage_max)
        self._question = protocol.encode(f"POS? {params.axis}")

    def _recover(self) -> None:
        """See that the next answer belongs to the next question."""
        self._skip_to(b"\n" + protocol.encode(IDENTIFY), self._mark)

    def _identify(self) -> None:
        params = self._params
        answer = self._ask(IDENTIFY)
        self.identity = " ".join(answer)
        self._mark = re.compile(re.escape(" \n".join(answer).encode(protocol.CODEC)) + b" *\n")
        if MAKER not in self.identity or params.device not in self.identity:
            raise ParameterError(
                f"device = {params.device!r}: at {params.address} is {self.identity[:80]!r}; "
                "check the address"
            )
        version = protocol.number(self._ask("CSV?")[0])
        if not 2.0 <= version < 3.0:
            raise ParameterError(
                f"device = {params.device!r}: {self.identity} speaks GCS {version:g}; must be 2.0"
            )

    def _fit(self) -> None:
        """See axis and servo, read the limits."""
        axis = self._params.axis
        self._ask("ERR?")  # of whoever was here before
        axes = [line.strip() for line in self._ask("SAI?")]
        if axis not in axes:
            raise ParameterError(f"axis = {axis!r}: {self.identity} has {', '.join(axes)}")
        if self._value("SVO?") != 0.0:
            raise ParameterError(
                f"axis = {axis!r}: its servo is on, two controllers would fight; switch it "
                f"off with SVO {axis} 0, when the stage may move"
            )
        self._open().send(protocol.encode(f"SVO {axis} 0"))
        low, high = self._value("TMN?"), self._value("TMX?")
        if not low < high:
            raise ParameterError(
                f"axis = {axis!r}: {self.identity} reports a travel of {low:g} to {high:g} "
                "um; is a stage connected?"
            )
        self._sensor = self._sensor_over(low, high)
        self.limits = Limits(*self._reach(*self._commands()), *self._sensor.image)

    def _commands(self) -> tuple[float, float]:
        """Lowest and highest command: what the controller tells, what the rig narrows or says."""
        params = self._params
        low, high = params.command_min, params.command_max
        lowest, highest = self._ask_if_known("VMI?"), self._ask_if_known("VMA?")
        if lowest is not None and highest is not None:
            if low < high:
                low, high = max(low, lowest), min(high, highest)
            else:
                low, high = lowest, highest
        if not low < high:
            raise ParameterError(
                f"command_max = {params.command_max:g}: {self.identity} does not tell the range "
                "of its amplifier; give command_min and command_max from its data sheet"
            )
        return low, high

    def _held(self) -> float:
        return self._amplifier.inverse(self._value("SVA?"))

    def _exchange(self, u: float) -> Measurement:
        held, line = self._u, self._line(u)
        return self._measurement(line + self._question, held)

    def _read(self) -> Measurement:
        return self._measurement(self._question, self._u)

    def _write(self, u: float) -> None:
        self._open().send(self._line(u))

    def _check(self) -> None:
        code = protocol.error(self._ask("ERR?"))
        if code:
            self._astray = True  # what it holds is to be asked
            raise self._wrong(f"{protocol.named(code)}; see the controller, then reset")

    def last_resort(self, u: float) -> bytes:
        """Bytes that command u (V), servo off; a line that broke off before them ends there."""
        axis = self._params.axis
        return b"\n" + protocol.encode(f"SVO {axis} 0", f"SVA {axis} {self._command(u):.6f}")

    def question(self) -> Question:
        """How to ask what is held."""
        axis = self._params.axis
        answer = b"(?:^|\n)" + re.escape(axis.encode(protocol.CODEC)) + rb"=([-+\d.eE]+) *\n"
        return Question(b"\n" + protocol.encode(f"SVA? {axis}"), answer, "", self._command)

    def _line(self, u: float) -> bytes:
        """Line that commands u (V); the device will hold what the line says."""
        return protocol.encode(f"SVA {self._pair(u)}")

    def _pair(self, u: float) -> str:
        """Axis and command for u (V)."""
        text = f"{self._command(u):.6f}"
        self._u = self._amplifier.inverse(float(text))
        return f"{self._params.axis} {text}"

    def _measurement(self, request: bytes, held: float) -> Measurement:
        (answer,) = self._answered(request)
        reading = protocol.value(answer, self._params.axis)
        return Measurement(self._sensor(reading), math.nan, held)

    def _ask(self, question: str) -> list[str]:
        (answer,) = self._answered(protocol.encode(question))
        return answer

    def _value(self, question: str) -> float:
        """The value that the axis has."""
        axis = self._params.axis
        return protocol.value(self._ask(f"{question} {axis}"), axis)

    def _ask_if_known(self, question: str) -> float | None:
        """The value, None where the controller does not know the question."""
        axis = self._params.axis
        request = protocol.encode(f"{question} {axis}", "ERR?")
        first, *rest = self._answered(request, lambda first: 2 if "=" in first[0] else 1)
        known = rest and protocol.error(rest[0]) == 0
        return protocol.value(first, axis) if known else None

    def _answered(
        self, request: bytes, count: Callable[[list[str]], int] = lambda first: 1
    ) -> list[list[str]]:
        """Answers to a request, the first of which says how many there are."""
        reader = protocol.AnswerReader()
        found: list[list[str]] = []

        def take(data: bytes) -> list[list[str]] | None:
            found.extend(reader.feed(data))
            if not found or len(found) < (wanted := count(found[0])):
                return None
            if len(found) > wanted or reader.begun:
                raise self._unasked(data)
            return found

        return self._talk(request, take)


class GcsChannels(Gcs):
    """Driver of several axes of a PI controller: all of them in one exchange.

    Voltages, measurements and limits are tuples, one an axis; see `several`.

    Attributes
    ----------
    channels : tuple of Gcs
        Each for one axis, over the same connection.
    """

    def __init__(self, plants: Sequence[Any]) -> None:
        first = plants[0]
        super().__init__(first.driver, first.voltage_min, first.voltage_max)
        others = [Gcs(each.driver, each.voltage_min, each.voltage_max) for each in plants[1:]]
        self.channels: tuple[Gcs, ...] = (self, *others)
        names = " ".join(each._params.axis for each in self.channels)
        self._question = protocol.encode(f"POS? {names}")

    def _fit(self) -> None:
        super()._fit()
        for each in self.channels[1:]:
            each.way, each.identity, each._astray = self.way, self.identity, False
            each._fit()
            within(each.limits, *each._range, f"axis {each._params.axis} of {each.identity}")

    def close(self) -> None:
        """Close the connection; the device holds its voltages."""
        for each in self.channels[1:]:
            each.way = None
        super().close()

    def _held(self) -> float:
        for each in self.channels[1:]:
            each._u = Gcs._held(each)
        return super()._held()

    def _exchange(self, u: Any) -> Any:
        held = tuple(each._u for each in self.channels)
        return self._measurements(self._lines(u) + self._question, held)

    def _read(self) -> Any:
        return self._measurements(self._question, tuple(each._u for each in self.channels))

    def _write(self, u: Any) -> None:
        self._open().send(self._lines(u))

    def _lines(self, u: Sequence[float]) -> bytes:
        """One line that commands all axes."""
        pairs = [each._pair(one) for each, one in zip(self.channels, u, strict=True)]
        return protocol.encode("SVA " + " ".join(pairs))

    def _measurements(self, request: bytes, held: tuple[float, ...]) -> Any:
        (answer,) = self._answered(request)
        y = tuple(each._sensor(protocol.value(answer, each._params.axis)) for each in self.channels)
        return Measurement(y, (math.nan,) * len(y), held)  # type: ignore[arg-type]

    def last_resort(self, u: Any) -> bytes:
        """The same for all axes."""
        pairs = zip(self.commands, u, strict=True)
        return b"".join(command(one) for command, one in pairs)

    @property
    def commands(self) -> tuple[Callable[[float], bytes], ...]:
        """What commands a voltage (V) of each axis whatever was sent before."""
        return (super().last_resort, *(each.last_resort for each in self.channels[1:]))

    def question(self) -> Any:
        """How to ask what each axis holds."""
        return (super().question(), *(each.question() for each in self.channels[1:]))


def several(plants: Sequence[Any], T_s: float) -> GcsChannels:
    """Driver of several axes, each with the plant's parameters of its own."""
    return GcsChannels(plants)


def make(plant: Any, T_s: float) -> Gcs:
    """Driver for the plant's parameters."""
    return Gcs(plant.driver, plant.voltage_min, plant.voltage_max)
