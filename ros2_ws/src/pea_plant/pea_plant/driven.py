"""A rig as the plant of a loop in this process.

Once a sample, at its deadline, the command of the sample before is exchanged for y_k: one cycle of
the device, and the command acts one sample later (``delay_samples: 1``). All of it is Python and
belongs to the thread of the loop.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np

from pea_core.block import Block
from pea_core.loop import LoopFault
from pea_core.signals import Measurement
from pea_core.units import SECOND
from pea_plant import gate
from pea_plant.rig import Rig, Stopped

GRACE = 1.0
"""Seconds that a driver has to come back after the watchdog has taken its device."""


class Driven(Block):
    """Plant of a loop in wall time that is a device.

    Parameters
    ----------
    params : pea_plant.plant.Params
    T_s : float
        Sample period (s).
    desired : callable
        Desired displacement (m) at a sample, for the gate.
    driver : Driver, optional
        In place of the one that the parameters choose.

    Attributes
    ----------
    rig : Rig
        What the loop drives.
    compiled : bool
        Whether its cycle compiles.

    Raises
    ------
    ParameterError
        A limit that every rig needs is missing, or the driver cannot be designed.
    """

    compiled = False

    def __init__(
        self, params: object, T_s: float, desired: Callable[[int], float], driver: object = None
    ) -> None:
        self.rig = Rig(params, T_s, driver)
        self._desired = desired
        self._asked = math.nan
        self._k, self._done = 0, -1
        model = SimpleNamespace(
            design=self._design, start=lambda c: None, output=self._output, update=self._update
        )
        super().__init__(model, params, T_s)

    def _design(self, params: Any, T_s: float) -> gate.Coefficients:
        """Limits of the gate, if the rig may take them now."""
        self.rig.check(params)
        return gate.design(params.safety, params.voltage_min, params.voltage_max, T_s)

    def adopt(self, params: object, c: object) -> None:
        """Swap in new limits."""
        self.rig.adopt(params)
        super().adopt(params, c)

    def noise(self, samples: int) -> list[float]:
        """No noise but the device's own."""
        return [0.0] * samples

    def connect(self) -> str:
        """Connect, start the watchdog, and open the gate at the voltage there is.

        Returns
        -------
        str
            Who answered, for people.

        Raises
        ------
        ParameterError, DriverError
            The device is not there, or not what the parameters say; it is closed again.
        """
        told = self.rig.connect("the start of the run")
        self.rig.gate.activate("the start of the run")
        return told

    def _output(self, c: object, s: object, noise: float) -> Measurement:
        """Exchange the command of the sample before for y_k, once a sample."""
        k, rig = self._k, self.rig
        if k == self._done:
            return rig.measured
        rig.gate.stamp = round(k * self.T_s * SECOND)
        if not rig.step(self._asked, k > 0, self._desired(k)):
            assert rig.failure is not None
            raise LoopFault(f"the safety gate has tripped: {rig.gate.cause}")
        if rig.gate.s.state == gate.FAULT and rig.gate.at_rest:
            raise LoopFault(f"the safety gate has tripped: {rig.gate.cause}")
        self._done = k
        return rig.measured

    def _update(self, c: object, s: object, noise: float, measured: Measurement, u: float) -> None:
        """Keep the command for the next sample."""
        self._asked = u
        self._k += 1

    def look(self) -> None:
        """See what has happened, from another thread: here the thread of the loop does it."""

    def stop(self, cause: str) -> Stopped:
        """Emergency stop, from another thread; what was reached."""
        return self.rig.stop(cause)

    @property
    def lost(self) -> int:
        """Samples of the device that never came; unknown here."""
        return 0

    def took(self, k: int, count: int) -> np.ndarray:
        """How long the exchanges of samples k to k + count took (ns); not measured here."""
        return np.empty(0, np.int64)

    def hangs(self) -> bool:
        """Whether the driver does not come back, though it was given time after the watchdog."""
        return time.monotonic() > self.rig.until + GRACE

    def close(self) -> None:
        """Ramp to the safe voltage at the pace of the loop and release."""
        self.rig.close("the end of the run")
