"""What drivers of devices have in common: an address, a calibration, one connection, deadlines.

A driver of a device extends `Device` and says how the device is told by its name, what it can do
and what it holds; besides it exchanges, as `pea_plant.drivers.driver` asks.

Each of `connect`, `exchange`, `read`, `write` and `check` has one deadline for the whole of it. A
driver is in step when every answer that was asked for has come and nothing else has. Out of step,
it first makes sure that the next answer belongs to the next question, and asks what is held. Where
answers have numbers, one that comes again is left out, and costs no question.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, ClassVar, TypeVar

from pea_core.params import ParameterError, group, param
from pea_core.signals import Measurement
from pea_drivers import calibration, transport
from pea_drivers.calibration import CalibrationCurve
from pea_drivers.transport import Deadline, Transport
from pea_plant.drivers.driver import DriverError, Limits, refusing, within

LONGEST = 1024
"""Bytes that are kept while an answer is looked for."""

T = TypeVar("T")


@dataclass(frozen=True)
class Params:
    """Where a device is, and what its numbers mean."""

    address: str = param("tcp://127.0.0.1:50000", help="tcp://HOST:PORT or serial:…", fixed=True)
    timeout_s: float = param(
        0.1, "s", 1e-3, 60.0, help="longest wait for the whole of an answer", fixed=True
    )
    connect_s: float = param(
        5.0, "s", 1e-2, 60.0, help="longest wait for the whole of connecting", fixed=True
    )
    calibration: calibration.Params = group(calibration.Params)

    def __post_init__(self) -> None:
        transport.parse(self.address)


class Device:
    """Driver of a device, without its protocol.

    Parameters
    ----------
    params : Params
    voltage_min, voltage_max : float
        Range that the plant asks for (V).

    Attributes
    ----------
    NAME : str
        What answers at the right address.
    PADDING : bytes
        Bytes that the device may send between its answers.
    NUMBERED : bool
        Whether an answer says to which question it belongs.
    limits, identity
        See `pea_plant.drivers.driver.Driver`.

    Raises
    ------
    ParameterError
        The amplifier's calibration is not monotone over that range.
    ModuleNotFoundError
        A Python package that the way to the device needs is missing.
    """

    NAME: ClassVar[str] = "device"
    PADDING: ClassVar[bytes] = b""
    NUMBERED: ClassVar[bool] = False
    limits: Limits
    identity: str

    def __init__(self, params: Any, voltage_min: float, voltage_max: float) -> None:
        transport.prepare(params.address)
        self._params = params
        self._range = voltage_min, voltage_max
        self._amplifier = CalibrationCurve(
            "calibration.amplifier", params.calibration.amplifier, *self._range
        )
        self.way: Transport | None = None
        self._u = 0.0
        self._astray, self._marks = False, 0

    def connect(self) -> None:
        """Open, identify, refuse what does not fit, see what is held; nothing is commanded."""
        params = self._params
        self.close()
        with refusing(self.close):
            self.way = transport.connect(params.address, Deadline(params.connect_s))
            self.way.drop()
            self._astray, self._marks = False, 0
            self._begin()
            try:
                self._identify()
            except DriverError as error:
                raise self._refusal(f"no {self.NAME} answers ({error})") from None
            with self._naming():
                self._fit()
            try:
                within(self.limits, *self._range, self.identity)
            except ParameterError as error:
                raise DriverError(str(error)) from None  # of the plant, not of the driver
            with self._naming():
                self._u = self._held()
                self._read()
                self._check()

    def exchange(self, u: float) -> Measurement:
        """Command u (V) and tell the newest displacement, in one cycle of the device."""
        self._start()
        return self._exchange(u)

    def read(self) -> Measurement:
        """Tell the newest displacement (m) and the voltage held (V)."""
        self._start()
        return self._read()

    def write(self, u: float) -> None:
        """Command u (V), and wait for no answer."""
        self._open().deadline = Deadline(self._params.timeout_s)
        self._write(u)

    def check(self) -> None:
        """Ask the device whether it found anything wrong."""
        self._start()
        self._check()

    def fileno(self) -> int:
        """File descriptor of the connection, -1 where there is none."""
        return -1 if self.way is None else self.way.fileno()

    def close(self) -> None:
        """Close the connection; the device holds its voltage."""
        if self.way is not None:
            self.way.close()
            self.way = None

    def _exchange(self, u: float) -> Measurement:
        """See `exchange`; in step, before the deadline."""
        raise NotImplementedError

    def _read(self) -> Measurement:
        """See `read`; in step, before the deadline."""
        raise NotImplementedError

    def _write(self, u: float) -> None:
        """See `write`; before the deadline."""
        raise NotImplementedError

    def _check(self) -> None:
        """See `check`; in step, before the deadline."""
        raise NotImplementedError

    def _begin(self) -> None:
        """Forget what has come so far, where something is kept."""

    def _recover(self) -> None:
        """See that the next answer belongs to the next question."""
        raise NotImplementedError

    def _identify(self) -> None:
        """Ask who is there; refuse another device."""
        raise NotImplementedError

    def _fit(self) -> None:
        """Refuse a device that is not ready; read its limits."""
        raise NotImplementedError

    def _held(self) -> float:
        """Voltage (V) that the device holds, asked of it."""
        raise NotImplementedError

    def _start(self) -> None:
        """Give an exchange its deadline, and get into step."""
        way = self._open()
        way.deadline = Deadline(self._params.timeout_s)
        if not (self._astray or self.NUMBERED) and way.comes_within(0.0):
            said = way.receive()
            self._astray = bool(said.strip(self.PADDING))
            if self._astray:
                raise self._unasked(said)
        if self._astray:
            self._recover()
            self._begin()
            self._u = self._held()
            self._astray = False

    def _talk(self, request: bytes, take: Callable[[bytes], T | None]) -> T:
        """Send a request, and hand what comes to `take` until that has the whole answer.

        Raises
        ------
        DriverError
            No whole answer before the deadline, or `take` refuses it; out of step then.
        """
        way, astray = self._open(), self._astray
        self._astray = True
        way.send(request)
        while (answer := take(way.receive())) is None:
            pass
        self._astray = astray
        return answer

    def _skip_to(self, question: bytes, answer: re.Pattern[bytes], hush: float = 0.0) -> None:
        """Ask a question whose answer no other has, and throw away what comes before it.

        Parameters
        ----------
        hush : float
            Silence (s) that ends it, where somebody else may have asked the same.

        Raises
        ------
        DriverError
            It does not come before the deadline, or something comes after it.
        """
        way = self._open()
        way.send(question)
        self._marks += 1
        seen = b""
        while self._marks > 0 or way.comes_within(hush):
            seen += way.receive()
            ends = [mark.end() for mark in answer.finditer(seen)]
            self._marks = max(self._marks - len(ends), 0)
            seen = seen[ends[-1] :] if ends else seen[-LONGEST:]
        if seen and not hush:
            raise self._unasked(seen)

    @contextlib.contextmanager
    def _naming(self) -> Iterator[None]:
        """Have each error name the address."""
        try:
            yield
        except DriverError as error:
            text = str(error)
            raise (error if self._params.address in text else self._wrong(text)) from None

    def _unasked(self, data: bytes) -> DriverError:
        return self._wrong(f"{data[:20]!r} answers nothing that was asked; who else is connected?")

    def _sensor_over(self, low: float, high: float) -> CalibrationCurve:
        """Displacement (m) of a reading between two."""
        terms = self._params.calibration.sensor
        return CalibrationCurve("calibration.sensor", terms, low, high, scale=1e-6)

    def _reach(self, low: float, high: float) -> tuple[float, float]:
        """Voltages at the actuator (V) between two commands, the lower one first."""
        ends = self._amplifier.inverse(low), self._amplifier.inverse(high)
        return min(ends), max(ends)

    def _command(self, u: float) -> float:
        """What the device is to be told for u (V).

        Raises
        ------
        DriverError
            u is outside the range.
        """
        low, high = self._range
        if not low <= u <= high:
            raise DriverError(f"voltage {u}: must be within {low:g} to {high:g} V")
        return self._amplifier(u)

    def _open(self) -> Transport:
        if self.way is None:
            raise self._wrong("not connected; connect first")
        return self.way

    def _wrong(self, what: str) -> DriverError:
        return DriverError(f"{self._params.address}: {what}")

    def _refusal(self, what: str) -> ParameterError:
        return ParameterError(f"address = {self._params.address!r}: {what}")
