"""What drivers of devices have in common: an address, a calibration, one connection.

A driver of a device extends `Device` and says how the device is told by its name, what it can do
and what it holds; besides it exchanges, as `pea_plant.drivers.driver` asks.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from pea_core.params import ParameterError, group, param
from pea_core.signals import Measurement
from pea_plant.drivers import calibration, transport
from pea_plant.drivers.calibration import Curve
from pea_plant.drivers.driver import DriverError, Limits, refusing, within
from pea_plant.drivers.transport import Transport

PATIENCE = 2.0
"""Longest wait for each answer while connecting (s): nothing moves, and some need time."""


@dataclass(frozen=True)
class Params:
    """Where a device is, and what its numbers mean."""

    address: str = param("tcp://127.0.0.1:50000", help="tcp://HOST:PORT or serial:…", fixed=True)
    timeout_s: float = param(0.1, "s", 1e-3, 60.0, help="longest wait for an answer", fixed=True)
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
    limits, identity
        See `pea_plant.drivers.driver.Driver`.

    Raises
    ------
    ParameterError
        The amplifier's calibration is not monotone over that range.
    """

    NAME: ClassVar[str] = "device"
    limits: Limits
    identity: str

    def __init__(self, params: Any, voltage_min: float, voltage_max: float) -> None:
        self._params = params
        self._range = voltage_min, voltage_max
        self._amplifier = Curve("calibration.amplifier", params.calibration.amplifier, *self._range)
        self._way: Transport | None = None
        self._u = 0.0

    def connect(self) -> None:
        """Open, identify, refuse what does not fit, see what is held; nothing is commanded."""
        params = self._params
        self.close()
        with refusing(self.close):
            self._way = transport.connect(params.address, max(PATIENCE, params.timeout_s))
            self._begin()
            try:
                self._identify()
            except DriverError as error:
                raise self._refusal(f"no {self.NAME} answers ({error})") from None
            self._fit()
            try:
                within(self.limits, *self._range, self.identity)
            except ParameterError as error:
                raise DriverError(str(error)) from None  # of the plant, not of the driver
            self._u = self._held()
            self.read()
            self.check()
            self._way.timeout = params.timeout_s

    def fileno(self) -> int:
        """File descriptor of the connection, -1 where there is none."""
        return -1 if self._way is None else self._way.fileno()

    def close(self) -> None:
        """Close the connection; the device holds its voltage."""
        if self._way is not None:
            self._way.close()
            self._way = None

    def read(self) -> Measurement:
        """Tell the newest displacement (m) and the voltage held (V)."""
        raise NotImplementedError

    def check(self) -> None:
        """Ask the device whether it found anything wrong."""
        raise NotImplementedError

    def _begin(self) -> None:
        """Forget what came over another connection."""
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

    def _sensor_over(self, low: float, high: float) -> Curve:
        """Displacement (m) of a reading between two."""
        terms = self._params.calibration.sensor
        return Curve("calibration.sensor", terms, low, high, scale=1e-6)

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
        if self._way is None:
            raise self._wrong("not connected; connect first")
        return self._way

    def _wrong(self, what: str) -> DriverError:
        return DriverError(f"{self._params.address}: {what}")

    def _refusal(self, what: str) -> ParameterError:
        return ParameterError(f"address = {self._params.address!r}: {what}")
