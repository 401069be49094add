"""A rig as the plant of a loop in this process.

Once a sample, at its deadline, the command of the sample before is exchanged for y_k: one cycle of
the device, and the command acts one sample later (``delay_samples: 1``). All of it is Python and
belongs to the thread of the loop.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np

from pea_core.axes import per_axis
from pea_core.block import Block
from pea_core.loop import LoopFault
from pea_core.matrix_filter import at_rest, remember
from pea_core.signals import Measurement
from pea_core.units import SECOND
from pea_plant import gate
from pea_plant.model.stage import matrix, taps
from pea_plant.rig import Rig, Stopped

GRACE = 1.0
"""Seconds that a driver has to come back after the watchdog has taken its device."""


class Between:
    """Matrices between the channels of a device and the axes of a loop, see `model.stage`.

    Parameters
    ----------
    params : sequence of pea_plant.plant.Params
        One an axis.

    Raises
    ------
    ParameterError
        A matrix is singular, or has another size.
    """

    def __init__(self, params: Sequence[Any]) -> None:
        stage, n = params[0].stage, len(params)
        self.S = matrix(stage.sensors_to_axes, n, "sensors_to_axes")
        self.A = taps(stage.axes_to_actuators, n)
        self._sensed, self._shared = bool(stage.sensors_to_axes), bool(stage.axes_to_actuators)
        self.S_inverse, self.A_inverse = np.linalg.inv(self.S), np.linalg.inv(self.A[0])
        self._past, self._told = at_rest(self.A), np.zeros(n)

    def actuators(self, u: tuple[float, ...]) -> tuple[float, ...]:
        """Voltages of the actuators (V) for the commands of the axes: once a sample."""
        if not self._shared:
            return u
        later = self._later(self._past.u)
        if len(self.A) > 1 and np.isfinite(u).all():
            remember(self._past.u, u)
            remember(self._past.told, self._told)
        return tuple((self.A[0] @ u + later).tolist())

    def _later(self, past: np.ndarray) -> Any:
        """What the taps after the first one give the actuators (V)."""
        return np.einsum("mij,mj->i", self.A[1:], past)

    def sensors(self, w: tuple[float, ...]) -> tuple[float, ...]:
        """What the sensors say (m) where the axes are at w."""
        return tuple((self.S_inverse @ w).tolist()) if self._sensed else w

    def axes(self, measured: Any) -> tuple[Measurement, ...]:
        """Measurements of the axes."""
        y, y_dot, u = measured
        if self._sensed:
            y = (self.S @ y).tolist()
        if self._shared:
            self._told = self.A_inverse @ (u - self._later(self._past.told))
            u = self._told.tolist()
        return tuple(map(Measurement, y, y_dot, u))


class Driven(Block):
    """Plant of a loop in wall time that is a device.

    Parameters
    ----------
    params : pea_plant.plant.Params
        Of several axes a tuple of them; signals are tuples then, too.
    T_s : float
        Sample period (s).
    desired : callable
        Desired displacement (m) at a sample, for the gate.
    driver : Driver, optional
        In place of the one that the parameters choose.
    axes : sequence of str
        Names of several axes.

    Attributes
    ----------
    rig : Rig
        What the loop drives.
    marked : callable
        Whether the driver's trigger output is set at a sample.
    detected : deque of float
        The sample signal of each sample that nobody has taken yet.
    compiled : bool
        Whether its cycle compiles.

    Raises
    ------
    ParameterError
        A limit that every rig needs is missing, or the driver cannot be designed.
    """

    compiled = False

    def __init__(
        self,
        params: Any,
        T_s: float,
        desired: Callable[[int], Any],
        driver: object = None,
        axes: Sequence[str] = (),
    ) -> None:
        self.rig = Rig(params, T_s, driver, axes=axes)
        self.marked: Callable[[int], bool] = lambda k: False
        self.detected: deque[float] = deque()
        self._desired = desired
        self._asked = self.rig.nothing
        self._between = Between(params) if type(params) is tuple else None
        self._k, self._done = 0, -1
        model = SimpleNamespace(
            design=self._design, start=lambda c: None, output=self._output, update=self._update
        )
        super().__init__(model, params, T_s)

    def _design(self, params: Any, T_s: float) -> Any:
        """Limits of the gate, if the rig may take them now; of each axis's."""
        self.rig.check(params)
        found = tuple(
            gate.design(own.safety, own.voltage_min, own.voltage_max, T_s)
            for own in per_axis(params)
        )
        return found if type(params) is tuple else found[0]

    def adopt(self, params: object, c: object) -> None:
        """Swap in new limits."""
        self.rig.adopt(params)
        super().adopt(params, c)

    def noise(self, samples: int) -> Any:
        """No noise but the device's own."""
        if self._between is not None:
            return np.zeros((samples, len(self._asked)))
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

    def _output(self, c: object, s: object, noise: float) -> Any:
        """Exchange the command of the sample before for y_k, once a sample."""
        k, rig, between = self._k, self.rig, self._between
        if k == self._done:
            return self._measured()
        rig.gate.stamp = round(k * self.T_s * SECOND)
        u, w = self._asked, self._desired(k)
        if between is not None:
            u, w = between.actuators(u), between.sensors(w)
        if self.marked(k):
            rig.driver.mark()
        if not rig.step(u, k > 0, w):
            assert rig.failure is not None
            raise LoopFault(f"the safety gate has tripped: {rig.gate.cause}")
        if rig.gate.s.state == gate.FAULT and rig.gate.at_rest:
            raise LoopFault(f"the safety gate has tripped: {rig.gate.cause}")
        self._done = k
        self.detected.append(rig.signal)
        return self._measured()

    def _measured(self) -> Any:
        """What the device said last; of each axis."""
        measured = self.rig.measured
        return measured if self._between is None else self._between.axes(measured)

    def _update(self, c: object, s: object, noise: float, measured: Any, u: Any) -> None:
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

    def signal(self, count: int) -> np.ndarray:
        """The sample signal of the next samples that nobody has asked for: (count,) array."""
        told = [self.detected.popleft() for _ in range(min(count, len(self.detected)))]
        return np.array(told + [math.nan] * (count - len(told)))

    def hangs(self) -> bool:
        """Whether the driver does not come back, though it was given time after the watchdog."""
        return time.monotonic() > self.rig.until + GRACE

    def close(self) -> None:
        """Ramp to the safe voltage at the pace of the loop and release."""
        self.rig.close("the end of the run")
