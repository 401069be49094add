"""What a driver is: a plant behind an amplifier and a sensor, in volts and metres.

A driver module offers

``Params``
    Frozen dataclass (`pea_core.params`): address, axis, calibration, timeouts; all of it fixed.
``make(plant, T_s)``
    The driver for the plant's parameters (`pea_plant.plant.Params`) and a sample period (s).
    Opens nothing, sends nothing.
``signal`` (optional, a property of the driver)
    The sample signal that came with the last `exchange` or `read`, in its own unit: what a detector
    beside the stage measures. NaN where it is not known, or not asked for.
``mark`` (optional, a method of the driver)
    Called before the exchange of a sample at which a trigger output shall be set.
``question`` (optional, a method of the driver)
    How the watchdog asks the device what it holds (`pea_watchdog.client.Question`).
``emulator`` (optional)
    Submodule with an ``Emulator`` of the device; see `pea_drivers.emulator`.

It is three layers: the wire protocol (bytes in and out, no I/O), a transport
(`pea_drivers.transport`), and the device, which is the driver itself.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import NamedTuple, Protocol

from pea_core.loop import LoopFault
from pea_core.params import ParameterError
from pea_core.signals import Measurement


class DriverError(LoopFault):
    """The device or the way to it failed; one line names what, the rule, and what to do."""


class Limits(NamedTuple):
    """What a device can do.

    Attributes
    ----------
    voltage_min, voltage_max : float
        Range of the voltage at the actuator (V).
    y_min, y_max : float
        Range of the displacement that its sensor tells (m).
    """

    voltage_min: float
    voltage_max: float
    y_min: float
    y_max: float


class Driver(Protocol):
    """Plant of the loop that is really there, or behaves so.

    Attributes
    ----------
    limits : Limits
        Of the device, known once it is connected.
    identity : str
        Who answered, in its own words; known once it is connected.
    """

    limits: Limits
    identity: str

    def connect(self) -> None:
        """Open the way to the device, see that it is the right one and ready, read its limits.

        Nothing moves: no voltage is commanded. What is open at an error is closed again.

        Raises
        ------
        ParameterError
            Address, device, axis, limits or calibration are wrong; one line.
        """

    def exchange(self, u: float) -> Measurement:
        """Command u (V) and tell the newest displacement, in one cycle of the device.

        Returns
        -------
        Measurement
            y (m) at the instant that u takes over; u_applied (V) is what the device held until
            then, not the command.

        Raises
        ------
        DriverError
            No whole answer within the time-out, or a wrong one.
        """

    def read(self) -> Measurement:
        """Tell the newest displacement (m) and the voltage that the device holds (V).

        Raises
        ------
        DriverError
            As `exchange`.
        """

    def write(self, u: float) -> None:
        """Command u (V), and wait for no answer.

        Raises
        ------
        DriverError
            It could not be sent.
        """

    def check(self) -> None:
        """Ask the device whether it found anything wrong: after a failure, and now and then.

        Not for every sample: it costs a cycle of its own.

        Raises
        ------
        DriverError
            It did, by the error's name; or it does not answer.
        """

    def last_resort(self, u: float) -> bytes:
        """Bytes that command u (V) whatever was sent before, for who holds the same connection.

        The same once it is closed here. Empty for a device without a connection.
        """

    def fileno(self) -> int:
        """File descriptor of the connection, -1 where there is none."""

    def close(self) -> None:
        """Close the connection; the device holds its voltage. May be called twice."""


def within(device: Limits, voltage_min: float, voltage_max: float, who: str) -> None:
    """Refuse voltages (V) that the device `who` does not have.

    Raises
    ------
    ParameterError
        The range is wider than the device's.
    """
    slack = 1e-9 * (device.voltage_max - device.voltage_min)
    for name, value, wrong in (
        ("voltage_min", voltage_min, voltage_min < device.voltage_min - slack),
        ("voltage_max", voltage_max, voltage_max > device.voltage_max + slack),
    ):
        if wrong:
            raise ParameterError(
                f"{name} = {value:g}: must lie within {device.voltage_min:g} to "
                f"{device.voltage_max:g} V, the limits of {who}; narrow it in the rig's file"
            )


@contextlib.contextmanager
def refusing(close: Callable[[], None]) -> Iterator[None]:
    """Around what `Driver.connect` does: at an error close, and call it bad input.

    Raises
    ------
    ParameterError
        Whatever went wrong.
    """
    try:
        yield
    except (DriverError, ParameterError) as error:
        close()
        if isinstance(error, ParameterError):
            raise ParameterError(f"driver.{error}") from None
        raise ParameterError(str(error)) from None
