"""A device as the plant of a loop in this process: driver, safety gate and guard as one block.

Once a sample, at its deadline, the command of the sample before passes the gate and is exchanged
for y_k: one cycle of the device, and the command acts one sample later (``delay_samples: 1``).
All of it is Python and belongs to the thread of the loop.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

from pea_core import pace
from pea_core.block import Block
from pea_core.loop import LoopFault
from pea_core.signals import Measurement
from pea_plant import drivers, safety
from pea_plant.drivers.driver import DriverError, within
from pea_plant.guard import Guard, guard
from pea_plant.safety import CLOCK, DRIVER, EMERGENCY_STOP, Gate

CHECK_EVERY = 0.05
"""Seconds between two questions whether the device found anything wrong."""

JUMP = 100
"""Periods between two samples that are no delay any more, where the gate has no limit of it."""


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
    gate : Gate
        What every command passes.

    Raises
    ------
    ParameterError
        A limit that every rig needs is missing, or the driver cannot be designed.
    """

    __slots__ = (
        *("_asked", "_check_at", "_desired", "_done", "_guard", "_halt", "_k", "_measured"),
        *("_stepped", "driver", "gate"),
    )

    def __init__(
        self, params: Any, T_s: float, desired: Callable[[int], float], driver: Any = None
    ) -> None:
        safety.refuse_unlimited(params)
        self.driver = drivers.make(params, T_s) if driver is None else driver
        self.gate = Gate(params, T_s)
        self._desired = desired
        self._guard: Guard | None = None
        self._asked, self._halt = math.nan, ""
        self._k, self._done = 0, -1
        self._measured = Measurement(math.nan, math.nan, 0.0)
        self._stepped = self._check_at = 0
        model = SimpleNamespace(
            design=self._design, start=lambda c: None, output=self._output, update=self._update
        )
        super().__init__(model, params, T_s)

    def _design(self, params: Any, T_s: float) -> safety.Coefficients:
        """Limits of the gate: no looser than now, once it is active."""
        if self.gate.s.state == safety.ACTIVE:
            safety.refuse_looser(self.params, params)
        safety.refuse_unlimited(params)
        return safety.design(params.safety, params.voltage_min, params.voltage_max, T_s)

    def adopt(self, params: Any, c: Any) -> None:
        """Swap in new limits."""
        self.gate.adopt(params)
        super().adopt(params, c)

    def noise(self, samples: int) -> list[float]:
        """No noise but the device's own."""
        return [0.0] * samples

    def connect(self) -> str:
        """Connect, start the guard, and open the gate at the voltage there is.

        Returns
        -------
        str
            Who answered, for people.

        Raises
        ------
        ParameterError, DriverError
            The device is not there, or not what the parameters say; it is closed again.
        """
        self.driver.connect()
        try:
            params, device = self.params, self.driver
            within(device.limits, params.voltage_min, params.voltage_max, device.identity)
            self._measured = device.read()
            self._guard, held = guard(
                lambda: drivers.make(params, self.T_s),
                device,
                self.gate.c,
                params.safety.slew_rate,
            )
        except BaseException:
            self.driver.close()
            raise
        self.gate.configure(self._measured.u_applied, "the start of the run")
        self.gate.activate("the start of the run")
        return f"{device.identity}, guard: {held}"

    def stop(self, cause: str) -> None:
        """Emergency stop at the next sample, from whatever thread."""
        self._halt = cause

    def _elapsed(self) -> float:
        """Sample periods since the last sample; the first one counts as one."""
        t = pace.now()
        elapsed = (t - self._stepped) / (self.T_s * pace.SECOND) if self._stepped else 1.0
        self._stepped = t
        return elapsed

    def _exchange(self, fresh: bool, w: float) -> None:
        """One sample: clock, gate, guard, driver."""
        elapsed = self._elapsed()
        limit = self.gate.c.stale or JUMP
        if elapsed > limit:
            text = f"{elapsed:.0f} periods between two samples, at most {limit} are a delay"
            self.gate.trip(CLOCK, text)
        if self._halt:
            self.gate.trip(EMERGENCY_STOP, self._halt)
            self._halt = ""
        v = self.gate.step(self._asked, fresh, self._measured.y, w, elapsed)
        if self._guard is not None:
            self._guard.tell(v)
        self._measured = self.driver.exchange(v)
        if self._stepped >= self._check_at:
            self._check_at = self._stepped + int(CHECK_EVERY * pace.SECOND)
            self.driver.check()

    def _output(self, c: Any, s: Any, noise: float) -> Measurement:
        """Exchange the command of the sample before for y_k, once a sample."""
        k, gate = self._k, self.gate
        if k == self._done:
            return self._measured
        gate.stamp = round(k * self.T_s * pace.SECOND)
        try:
            self._exchange(k > 0, self._desired(k))
        except DriverError as error:
            gate.trip(DRIVER, str(error))
            raise
        if gate.s.state == safety.FAULT and gate.at_rest:
            raise LoopFault(f"the safety gate has tripped: {gate.reason}")
        self._done = k
        return self._measured

    def _update(self, c: Any, s: Any, noise: float, measured: Measurement, u: float) -> None:
        """Keep the command for the next sample."""
        self._asked = u
        self._k += 1

    def close(self) -> None:
        """Ramp to the safe voltage at the pace of the loop, or have the guard do it; release.

        The guard does it where the device does not answer, and where a Ctrl-C ends the ramp. A
        second call does nothing.
        """
        self.gate.deactivate("the end of the run")
        period = round(self.T_s * pace.SECOND)
        try:
            while not self.gate.at_rest:
                pace.wait_until(self._stepped + period, 0)
                self._exchange(False, math.nan)
        except BaseException as error:
            if self._guard is not None:
                self._guard.fire()
                self._guard.done()
            if not isinstance(error, DriverError | OSError):
                raise
        finally:
            if self._guard is not None:
                self._guard.stand_down()
                self._guard = None
            with contextlib.suppress(Exception):
                self.driver.close()
            self.gate.cleanup("the end of the run")
