"""The running loop of a ROS domain, as the soft IOC shows it."""

from __future__ import annotations

import time
from collections.abc import Mapping

import numpy as np

from pea_core.config import NODES
from pea_core.params import ParameterError
from pea_dashboard.link import Link
from pea_dashboard.stop import Stop
from pea_dashboard.trace import Trace

PATIENCE = 30.0
"""Seconds that a loop has to be there."""

SCALES = {
    "Y": ("y", 1e6),
    "X1": ("x1_hat", 1e6),
    "EPS": ("eps_hat", 1.0),
    "U": ("u", 1.0),
    "UAPPLIED": ("u_applied", 1.0),
    "W": ("w", 1e6),
}
"""Signal of each process variable, and its factor to what is shown."""


class GraphDesk:
    """A loop over the ROS graph; see `epics.Desk`.

    Raises
    ------
    ParameterError
        No loop is there within `PATIENCE`.
    """

    def __init__(self, domain: int, namespace: str) -> None:
        self.trace = Trace()
        self._setpoint = 0.0
        self._end, self._came = 0, time.monotonic()
        self.link = Link(self.trace, lambda change: None, namespace)
        self._stop = Stop(domain, namespace)
        limit = time.monotonic() + PATIENCE
        while not {"controller", "reference"} <= self.link.values.keys():
            if time.monotonic() > limit:
                self.close()
                raise ParameterError(
                    f"no loop in ROS domain {domain}, namespace {namespace}: start one first, "
                    "with the same ROS_DOMAIN_ID"
                )
            time.sleep(0.1)

    def readings(self) -> Mapping[str, float]:
        """The newest value of each signal that is there."""
        end = self.trace.end
        if end != self._end:
            self._end, self._came = end, time.monotonic()
        if end <= self.trace.first:
            return {}
        names = [signal for signal, _ in SCALES.values()]
        found = self.trace.samples(end - 1, end, *names)
        return {
            name: float(found[signal][-1]) * scale
            for name, (signal, scale) in SCALES.items()
            if len(found[signal]) and np.isfinite(found[signal][-1])
        }

    def age(self) -> float:
        """Time since the newest sample came (s), to the nearest call of `readings`."""
        return time.monotonic() - self._came

    def gains(self) -> Mapping[str, float]:
        """Numbers of the controller, as it has told them last."""
        told = self.link.values.get("controller", {})
        return {name: value for name, value in told.items() if isinstance(value, float)}

    def setpoint(self) -> float:
        """Mean displacement (um), as the reference has told it last."""
        value = self.link.values.get("reference", {}).get("offset_um", self._setpoint)
        if isinstance(value, int | float):
            self._setpoint = float(value)
        return self._setpoint

    def set(self, role: str, values: Mapping[str, float]) -> None:
        """Change parameters of a node."""
        assert role in NODES
        self.link.set(role, values)

    def stop(self) -> str:
        """Bring the stage to its safe voltage."""
        return self._stop().text

    def close(self) -> None:
        """Leave the graph."""
        self.link.close()
        self._stop.close()
