"""A compiled driver as a driver like any other: for connecting, ramps, the graph, the watchdog.

The loop of one process calls the library's exchange itself, see `pea_native.cycle`.
"""

from __future__ import annotations

import json
import math
import os
import signal
import struct
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pea_core import claim
from pea_core.params import ParameterError, param
from pea_core.signals import Measurement
from pea_core.units import SECOND
from pea_native import build, library
from pea_native.library import DRY, FRESH, HOLD, Library, Line, Refused, Tried
from pea_plant.drivers.driver import DriverError, Limits, within

CHECK = 10.0
"""Seconds that the check has besides what its exchanges may take."""


@dataclass(frozen=True)
class Params:
    """Where a compiled driver finds its device, and who sets the pace."""

    address: str = param("", help="of the device, as its library reads it", fixed=True)
    pace: str = param(
        library.CLOCK,
        help="whose clock a sample waits for: the computer's, or the device's",
        choices=library.PACES,
        fixed=True,
    )
    timeout_s: float = param(0.01, "s", 1e-5, 60.0, help="longest exchange", fixed=True)
    connect_s: float = param(
        5.0, "s", 1e-2, 60.0, help="longest wait for the whole of connecting", fixed=True
    )


class Native:
    """Driver of a device by a shared library; see `pea_plant.drivers.driver.Driver`.

    Parameters
    ----------
    params : Params
    plant : pea_plant.plant.Params
        Whose range the device must have.
    T_s : float
        Sample period (s).
    path : Path
        The library.

    Attributes
    ----------
    loaded : Library or None
        Open while connected.
    rescue : tuple of str
        For the watchdog: a file of Python, and the text that its ``opened`` is given.
    tried : Tried or None
        What the check has found.
    """

    limits: Limits
    identity: str

    def __init__(self, params: Any, plant: Any, T_s: float, path: Path) -> None:
        if not params.address:
            raise ParameterError("address = '': say where the device is")
        self.line = Line(
            str(path),
            params.address,
            round(T_s * SECOND),
            params.timeout_s,
            params.connect_s,
            params.pace,
        )
        self._range = plant.voltage_min, plant.voltage_max
        self.rescue = (library.__file__, json.dumps(self.line))
        self.loaded: Library | None = None
        self.tried: Tried | None = None
        self._claim: Any = None
        self._file = -1

    def connect(self) -> None:
        """Check the library in a process of its own, open the device, see that it fits."""
        self.close()
        try:
            self._claim = claim.claim(self.line.address, "native", (self.line.address,))
            self.tried = self.try_out()
            self.loaded = Library(self.line)
            self.identity = self.loaded.identity() or Path(self.line.library).name
            self.limits = Limits(*self.loaded.limits())
            within(self.limits, *self._range, self.identity)
            self.read()
            self._file = os.open(os.devnull, os.O_WRONLY | os.O_CLOEXEC)
        except Refused as error:
            self.close()
            raise ParameterError(f"driver.address = {self.line.address!r}: {error}") from None
        except Exception:
            self.close()
            raise

    def try_out(self, exchanges: int = DRY) -> Tried:
        """See that the library keeps the rules, with the output held; it may crash or hang there.

        Raises
        ------
        ParameterError
            It does not; one line.
        """
        line = self.line
        command = [sys.executable, "-I", "-S", library.__file__]
        least = max(line.period_ns / SECOND, min(line.timeout_s, 1e-3))
        patience = CHECK + line.connect_s + 4.0 * exchanges * least
        try:
            done = subprocess.run(
                [*command, json.dumps(line), str(exchanges)],
                capture_output=True,
                text=True,
                timeout=patience,
            )
        except subprocess.TimeoutExpired:
            raise self._bad(
                f"did not come back within {patience:.3g} s while it was tried"
            ) from None
        if done.returncode < 0:
            name = signal.Signals(-done.returncode).name
            raise self._bad(f"crashed ({name}) while it was tried")
        try:
            told = json.loads(done.stdout.splitlines()[-1])
        except (IndexError, ValueError):
            raise self._bad(
                f"ended the process while it was tried {done.stderr[-200:]!r}"
            ) from None
        if "refused" in told:
            raise self._bad(told["refused"])
        tried = told["tried"]
        limits = tuple(tried["limits"])
        return Tried(tried["identity"], limits, tuple(tried["exchange_us"]), tried["counted"])

    def _bad(self, what: str) -> ParameterError:
        line = self.line
        return ParameterError(f"driver: {line.address!r} by the library {line.library}: {what}")

    def exchange(self, u: float) -> Measurement:
        """Command u (V) and return the newest displacement, in one cycle of the device."""
        low, high = self._range
        if not low <= u <= high and not self._outside(u):
            raise DriverError(f"voltage {u}: must be within {low:g} to {high:g} V")
        return self._exchange(u, 0)

    def _outside(self, u: float) -> bool:
        """Whether the device has u (V), outside of the plant's range: the gate ramps in."""
        return self.limits.voltage_min <= u <= self.limits.voltage_max

    def _exchange(self, u: float, flags: int) -> Measurement:
        try:
            sample = self._open().exchange(u, flags | FRESH)
            held = library.held(sample, self.limits.voltage_min, self.limits.voltage_max)
        except Refused as error:
            raise DriverError(f"{self.line.address}: {error}") from None
        return Measurement(sample.y, math.nan, held)

    def read(self) -> Measurement:
        """Return the newest displacement (m) and the voltage held (V)."""
        return self._exchange(math.nan, HOLD)

    def write(self, u: float) -> None:
        """Command u (V), and wait for no answer."""
        try:
            self._open().safe(u)
        except OSError as error:
            raise DriverError(f"{self.line.address}: {error}") from None

    def check(self) -> None:
        """Each exchange returns what is wrong."""

    def last_resort(self, u: float) -> bytes:
        """What the watchdog hands to the library, in its own process."""
        return struct.pack("<d", u)

    def fileno(self) -> int:
        """A file that stands for the connection; what is written there goes nowhere."""
        return self._file

    def close(self) -> None:
        """Close the device; it holds its voltage."""
        if self.loaded is not None:
            self.loaded.close()
            self.loaded = None
        if self._file >= 0:
            os.close(self._file)
            self._file = -1
        self._claim = None

    def _open(self) -> Library:
        if self.loaded is None:
            raise DriverError(f"{self.line.address}: not connected; connect first")
        return self.loaded


def of_package(name: str, plant: Any, T_s: float, libraries: Sequence[str] = ()) -> Native:
    """Driver by one of the sources that come with the package, compiled where needed."""
    path = build.made([build.NATIVE / f"{name}.c"], f"pea_{name}", libraries)
    return Native(plant.driver, plant, T_s, path)
