"""A rig with a compiled driver as the plant of a loop in this process.

Connecting, the watchdog and the way down are the `Rig`'s, as for every driver. From the first
sample on the compiled cycle (`pea_native.cycle`) does what `Rig.step` does. Another thread looks
at it now and then (`look`): what the gate says, and whether the watchdog lives.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np

from pea_core.signals import Measurement
from pea_core.units import SECOND
from pea_engine import pace
from pea_native import call, cycle, library
from pea_native.cycle import (
    CELLS,
    CODE,
    DONE,
    FAILED,
    GOES_ON,
    LOST,
    NO_NUMBER,
    OVERDUE,
    REQUEST,
    STARTED,
    TAKEN_OVER,
    TRIP_ELAPSED,
    TRIP_U,
    TRIP_Y,
    TRIPPED,
    UNFIT,
    VALUES,
    WHY,
    WRITES,
    Coefficients,
    State,
    U,
    Y,
)
from pea_plant import gate
from pea_plant.driven import Driven
from pea_plant.drivers.driver import DriverError
from pea_plant.rig import POLL, Stopped
from pea_watchdog.watchdog import STATE, WATCHING

CAPACITY = 1 << 16
"""Exchanges whose times are kept, a power of two."""

GATE = 12
"""Numbers of the gate's state."""


class NativeDriven(Driven):
    """Plant of a loop in wall time that is a device with a compiled driver.

    Parameters
    ----------
    params : pea_plant.plant.Params
    T_s : float
        Sample period (s).
    desired : callable
        Not needed: the loop shows each sample's.
    driver : Native, optional
        In place of the one that the parameters choose.

    Attributes
    ----------
    paced : bool
        Whether the device sets the pace.
    """

    compiled = True

    def __init__(
        self, params: Any, T_s: float, desired: Callable[[int], float], driver: Any = None
    ) -> None:
        self.paced = params.driver.pace == library.DEVICE
        self._lock = threading.Lock()
        self._halting = False
        super().__init__(params, T_s, desired, driver)
        call.native()
        self.model = SimpleNamespace(
            design=self._design,
            start=lambda c: None,
            output=cycle.output,
            update=cycle.update,
            aim=cycle.aim,
            halted=cycle.halted,
            timed=cycle.timed,
        )
        self.s: State = self._state()

    def _state(self) -> State:
        """A state without a device: what the kernel is compiled for."""
        sample = np.zeros(3)
        told = np.zeros((STATE + 1, 1), np.int64)
        told[STATE, 0] = WATCHING
        counts = np.zeros((CELLS, pace.LINE), np.int64)
        counts[DONE, 0] = -1
        return State(
            0,
            0,
            counts,
            np.full(VALUES, math.nan),
            np.zeros(GATE),
            sample,
            sample.view(np.int64),
            told,
            told.view(np.float64),
            np.zeros(CAPACITY, np.int64),
        )

    def _design(self, params: Any, T_s: float) -> Any:
        """Coefficients of the cycle, if the rig may take these limits now."""
        limits = super()._design(params, T_s)
        low, high = params.voltage_min, params.voltage_max
        if self.rig.connected:
            low, high = self.rig.driver.limits[:2]
        slack = 1e-6 * (high - low)
        return Coefficients(limits, round(T_s * SECOND), self.paced, low - slack, high + slack)

    def try_design(self, params: Any) -> None:
        """See whether the rig may take new limits, with the gate as it is now."""
        self.look()
        super().try_design(params)

    def adopt(self, params: Any, c: Any) -> None:
        """Swap in new limits: the watchdog's first."""
        self.look()
        super().adopt(params, c)

    def connect(self) -> str:
        """Connect as every rig, then hand the device to the compiled cycle."""
        text = super().connect()
        rig = self.rig
        driver, watchdog = rig.driver, rig.watchdog
        self.c = self._design(self.params, self.T_s)
        address = driver.loaded.functions["exchange"]
        fresh = self._state()
        told, volts = fresh.told, fresh.volts
        if watchdog is not None:
            counts, cells = watchdog.cells
            told = np.frombuffer(counts.cast("B"), np.int64).reshape(-1, 1)
            volts = np.frombuffer(cells.cast("B"), np.float64).reshape(-1, 1)
        self.s = fresh._replace(
            function=_address(address), device=driver.loaded.device, told=told, volts=volts
        )
        cycle.keep(self.s.gate, rig.gate.s)
        self.s.values[Y], self.s.values[U] = rig.measured.y, rig.measured.u_applied
        return text

    # What other threads do

    def look(self) -> None:
        """See what the cycle has done, hand it a wish to stop, look after the watchdog."""
        with self._lock:
            rig, n = self.rig, self.s.counts
            if not rig.connected or n[WHY, 0] != GOES_ON or self.s.function == 0:
                return
            self._follow()
            if rig.gate.s.state == gate.ACTIVE and not n[REQUEST, 0]:
                wrong = rig.watchdog.wrong if rig.watchdog is not None else ""
                if rig.halt_cause:
                    self._request(gate.EMERGENCY_STOP, rig.halt_cause)
                elif wrong:
                    self._request(gate.WATCHDOG, wrong)
            began, silence = int(n[STARTED, 0]), rig.params.safety.watchdog_s
            rig.until = began / SECOND + silence if began else math.inf

    def _request(self, reason: int, about: str) -> None:
        self._about = about
        pace.tell(self.s.counts, REQUEST, reason)

    def _follow(self) -> None:
        """Take over the gate's state; the lock is held."""
        n, f = self.s.counts, self.s.values
        while True:
            writes = pace.look(n, WRITES)
            state = cycle.kept_in(self.s.gate.tolist())
            if writes == pace.look(n, WRITES) and writes % 2 == 0:
                break
        own = self.rig.gate
        if state.state == gate.FAULT and own.s.state == gate.ACTIVE:
            own.stamp = round(int(n[TRIPPED, 0]) * self.T_s * SECOND)
            if state.reason == n[REQUEST, 0]:
                own.trip(state.reason, self._about)
                own.s = state
                self.rig.halt_cause = ""
            else:
                own.follow(state, f[TRIP_U], f[TRIP_Y], f[TRIP_ELAPSED])
        elif state.state == own.s.state:
            own.s = state

    def stop(self, cause: str) -> Stopped:
        """Emergency stop, from another thread; what was reached."""

        def advance() -> None:
            self.look()
            time.sleep(POLL)

        return self.rig.stop(cause, advance)

    def hangs(self) -> bool:
        """Whether the exchange does not come back, though it was given time after the watchdog."""
        self.look()
        return super().hangs()

    # The end

    def halt(self) -> str:
        """Why the cycle does not go on, for people; a lost device is left to the watchdog."""
        rig, n, f = self.rig, self.s.counts, self.s.values
        with self._lock:
            self._follow()
            why = n[WHY, 0]
            n[REQUEST, 0] = gate.NONE
        rig.until = math.inf
        about = f"{rig.driver.line.address}: "
        if why == FAILED:
            rig.lost(DriverError(about + library.code_of(int(n[CODE, 0]))))
        elif why == UNFIT:
            low, high = rig.driver.limits[:2]
            held = f"u_applied = {f[U]:g} V: the device's range is {low:g} to {high:g} V"
            rig.lost(DriverError(about + held))
        elif why == NO_NUMBER:
            rig.gate.trip(gate.SENSOR_NOT_FINITE, about + "y is no finite number")
        elif why == OVERDUE:
            rig.lost(DriverError(rig.gate.cause), rig.gate.s.reason)
        elif why == TAKEN_OVER:
            rig.look_after_watchdog()
        return f"the safety gate has tripped: {rig.gate.cause}"

    def close(self) -> None:
        """Ramp to the safe voltage and release; the cycle is over."""
        n = self.s.counts
        with self._lock:
            if self.rig.connected and n[WHY, 0] == GOES_ON and self.s.function:
                self._follow()
            n[WHY, 0] = n[WHY, 0] or TAKEN_OVER
            f = self.s.values
            self.rig.note(Measurement(f[Y], math.nan, f[U]))
        super().close()
        self.s = self._state()  # the memory shared with the watchdog goes

    @property
    def lost(self) -> int:
        """Samples of the device that never came."""
        return int(self.s.counts[LOST, 0])

    def took(self, k: int, count: int) -> np.ndarray:
        """How long the exchanges of samples k to k + count took (ns)."""
        return self.s.took[np.arange(k, k + count) & (CAPACITY - 1)]


def _address(function: Any) -> int:
    """Address of a function that ctypes has loaded."""
    import ctypes

    return int(ctypes.cast(function, ctypes.c_void_p).value or 0)
