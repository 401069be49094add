"""A soft IOC: the running loop as process variables of EPICS, over Channel Access.

The IOC reads an `IocDesk` a few times a second; nothing in the loop waits for it. What a client
writes is checked as any change of parameters: a refused value leaves the old one in force, and the
client gets an error.
"""

from __future__ import annotations

import asyncio
import logging
import math
import os
from collections.abc import Mapping
from typing import Any, Protocol

from caproto import (
    AccessRights,
    AlarmSeverity,
    AlarmStatus,
    ChannelDouble,
    ChannelInteger,
    ChannelString,
)
from caproto.asyncio.server import start_server

from pea_core.params import ParameterError

EVERY = 0.1
"""Seconds between two looks at the loop."""

LATE = 3.0
"""Seconds without a new sample after which readings are invalid."""

READINGS = {"Y": "um", "X1": "um", "EPS": "V", "U": "V", "UAPPLIED": "V", "W": "um"}
"""Process variables that are read only, and their units."""

TEXT = 39
"""Characters of a text over Channel Access."""

LOOPBACK = "127.0.0.1"

LOCAL = {"EPICS_CAS_AUTO_BEACON_ADDR_LIST": "NO", "EPICS_CAS_BEACON_ADDR_LIST": LOOPBACK}
"""Environment that keeps beacons on this machine, where nobody has set another."""


FINE = {"status": AlarmStatus.NO_ALARM, "severity": AlarmSeverity.NO_ALARM}
INVALID = {"status": AlarmStatus.COMM, "severity": AlarmSeverity.INVALID_ALARM}
"""Alarms of readings that are new, and of those that are old."""


class IocDesk(Protocol):
    """What the IOC shows and asks."""

    def readings(self) -> Mapping[str, float]:
        """The newest value of each of `READINGS` that is there."""

    def age(self) -> float:
        """Time since the newest sample came (s)."""

    def gains(self) -> Mapping[str, float]:
        """Numbers of the controller that may be changed."""

    def setpoint(self) -> float:
        """Mean displacement that the reference asks for (um)."""

    def set(self, role: str, values: Mapping[str, float]) -> None:
        """Change parameters, or raise ParameterError with one line."""

    def stop(self) -> str:
        """Bring the stage to its safe voltage; one line on what has become of it."""


class _ReadOnly(ChannelDouble):
    def check_access(self, hostname: str, username: str) -> AccessRights:
        return AccessRights.READ


class _Line(ChannelString):
    def check_access(self, hostname: str, username: str) -> AccessRights:
        return AccessRights.READ


class _Parameter(ChannelDouble):
    """A parameter of a node; writing it changes the node, or fails."""

    def __init__(self, ioc: Ioc, role: str, name: str, value: float, units: str = "") -> None:
        super().__init__(value=value, units=units, precision=9)
        self._ioc, self._role, self._name = ioc, role, name

    async def verify_value(self, data: Any) -> Any:
        value = float(data[0] if isinstance(data, list | tuple) else data)
        await self._ioc.change(self._role, self._name, value)
        return value


class _Stop(ChannelInteger):
    """Writing anything but 0 stops the stage."""

    def __init__(self, ioc: Ioc) -> None:
        super().__init__(value=0)
        self._ioc = ioc

    async def verify_value(self, data: Any) -> Any:
        if data[0] if isinstance(data, list | tuple) else data:
            await self._ioc.stop()
        return 0


class Ioc:
    """Process variables of a loop.

    Parameters
    ----------
    desk : IocDesk
    prefix : str
        How every name begins.
    """

    def __init__(self, desk: IocDesk, prefix: str) -> None:
        self.desk = desk
        self._readings = {
            name: _ReadOnly(value=math.nan, units=unit, precision=6)
            for name, unit in READINGS.items()
        }
        self._setpoint = _Parameter(self, "reference", "offset_um", desk.setpoint(), "um")
        self._gains = {
            name: _Parameter(self, "controller", name, value)
            for name, value in desk.gains().items()
        }
        self._message = _Line(value="")
        self.variables = {
            **{prefix + name: channel for name, channel in self._readings.items()},
            f"{prefix}SETPOINT": self._setpoint,
            **{f"{prefix}GAIN:{name}": channel for name, channel in self._gains.items()},
            f"{prefix}STOP": _Stop(self),
            f"{prefix}MESSAGE": self._message,
        }

    async def change(self, role: str, name: str, value: float) -> None:
        """Change one parameter; the message says why where it is refused."""
        loop = asyncio.get_running_loop()
        try:
            await loop.run_in_executor(None, self.desk.set, role, {name: value})
        except ParameterError as error:
            await self._say(str(error).rpartition(" refuses: ")[2])
            raise ValueError(str(error)) from None
        await self._say(f"{name} = {value:g}")

    async def stop(self) -> None:
        """Stop the stage; the message says what has become of it."""
        loop = asyncio.get_running_loop()
        await self._say(await loop.run_in_executor(None, self.desk.stop))

    async def _say(self, text: str) -> None:
        await self._message.write(text[:TEXT])

    async def _follow(self) -> None:
        old = False
        while True:
            readings, late = self.desk.readings(), self.desk.age() > LATE
            for name, channel in self._readings.items():
                if name in readings or late != old:
                    value = readings.get(name, channel.value)
                    await channel.write(value, **(INVALID if late else FINE))
            if late != old:
                old = late
                text = "no new sample: readings are invalid" if late else "new samples"
                await self._say(text)
            await self._renew(self._setpoint, self.desk.setpoint())
            fresh = self.desk.gains()
            for name, channel in self._gains.items():
                await self._renew(channel, fresh.get(name, channel.value))
            await asyncio.sleep(EVERY)

    async def _renew(self, channel: _Parameter, value: float) -> None:
        """Show what somebody else has set."""
        if value != channel.value:
            await channel.write(value, verify_value=False)

    async def serve(self, host: str = LOOPBACK) -> None:
        """Serve until cancelled."""
        for name, value in LOCAL.items():
            os.environ.setdefault(name, value)
        # it logs, with tracebacks, what clients are told anyway, and each beacon that nobody hears
        logging.getLogger("caproto").setLevel(logging.CRITICAL)
        both = [
            asyncio.ensure_future(self._follow()),
            asyncio.ensure_future(start_server(self.variables, interfaces=[host])),
        ]
        try:
            ended, _ = await asyncio.wait(both, return_when=asyncio.FIRST_COMPLETED)
            for task in ended:
                task.result()
        finally:
            for task in both:
                task.cancel()
