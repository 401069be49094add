"""Recordings to look through: the same windows as of a running loop."""

from __future__ import annotations

import contextlib
import itertools
import threading
from collections import OrderedDict
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pea_core.config import own_of
from pea_core.params import ParameterError
from pea_core.units import NS, SECOND
from pea_dashboard.foreign import number, plain
from pea_dashboard.trace import ALONG, SHOWN
from pea_experiment.metrics import truth
from pea_lab.guard import experiment_of
from pea_plant import drivers
from pea_record.contents import Contents
from pea_record.frame import load
from pea_record.read import path_and_axis
from pea_record.recording import BagError

PIECE = 50_000
"""Samples read at a time."""

KEPT = 16
"""Pieces kept in memory."""

TRUE_MAX = 2**21
"""Samples of a recording up to which its truth is found out, by simulating all of it."""


class RecordedTrace:
    """A recording, of which pieces are read when they are looked at.

    Parameters
    ----------
    path : Path
        A bag's directory, or an MCAP file; of one of several axes alone ``PATH@AXIS``.
    axis : str
        Of several the one that is shown; empty, or no such axis: the first.

    Attributes
    ----------
    axes : tuple of str
    axis : str
        The one that is shown.

    Raises
    ------
    BagError
        It is none.
    """

    def __init__(self, path: Path, axis: str = "") -> None:
        self.path = path
        there, _ = path_and_axis(path)
        contents = Contents(there)
        self._lock = threading.Lock()
        self._pieces: OrderedDict[int, dict[str, np.ndarray]] = OrderedDict()
        if contents.timed:
            self.T_ns = contents.T_ns
            self.first = min(place.first for place in contents.places) // self.T_ns
            self.end = max(place.last for place in contents.places) // self.T_ns + 1
            self._frame = None
        else:
            self._frame = load(path)
            self.T_ns = round(self._frame.T_s * SECOND)
            stamps = np.rint(self._frame.t * SECOND).astype(np.int64) // self.T_ns
            self.first, self.end = int(stamps[0]), int(stamps[-1]) + 1
        self._contents = contents
        frame = self._frame or load(path, self.first * self.T_ns * NS, None)
        self.axes = frame.axes
        self.axis = axis if axis in frame.axes else frame.axes[0]
        self._columns = {name: name for name in SHOWN}
        self.parameters = {
            node: own_of(frame.axes, self.axis, _flat(values))
            for node, values in frame.parameters.items()
        }
        if len(frame.axes) > 1:
            path_names = [f"{each}.{name}" for each in frame.axes for name in ALONG.values()]
            self._columns = {
                **{name: f"{self.axis}.{name}" for name in SHOWN},
                **dict(zip(path_names, path_names)),
            }
        plant = self.parameters.get("plant", {})
        self._eps = self._truth()
        self.limits = limits_of(plant)
        self.permitted = permitted_of(plant)

    def _truth(self) -> np.ndarray:
        """The true eps (V) of a simulated run, where it is short and recorded from its start."""
        nothing = np.empty(0)
        if len(self.axes) > 1:
            return nothing
        if self.first or self.end > TRUE_MAX or "plant" not in self.parameters:
            return nothing
        try:
            experiment = experiment_of(self.parameters)
            simulated = isinstance(experiment.nodes["plant"].params.driver, drivers.Simulated)
            samples = load(self.path).samples
            if not simulated or len(samples) != self.end:
                return nothing
            true = truth(experiment.plant(), samples, experiment.nominal)
        except (BagError, ParameterError, KeyError):
            return nothing
        return nothing if true is None else true["eps"]

    def samples(self, start: int, end: int, *names: str) -> dict[str, np.ndarray]:
        """Signals of the samples from `start` to before `end` that are there; `k` with them."""
        start, end = max(start, self.first), min(end, self.end)
        k = np.arange(start, max(end, start))
        numbers = range(start // PIECE, -(-end // PIECE))
        parts = [self._piece(number) for number in numbers] if len(k) else []
        found: dict[str, np.ndarray] = {"k": k}
        for name in names or (*self._columns, "eps"):
            column = np.full(len(k), np.nan)
            for piece, part in zip(numbers, parts):
                a, b = max(start, piece * PIECE), min(end, (piece + 1) * PIECE)
                column[a - start : b - start] = part[name][a - piece * PIECE : b - piece * PIECE]
            found[name] = column
        return found

    def _piece(self, number: int) -> dict[str, np.ndarray]:
        """Columns of the samples from `number` `PIECE` on."""
        with self._lock:
            if number in self._pieces:
                self._pieces.move_to_end(number)
                return self._pieces[number]
            columns = {name: np.full(PIECE, np.nan) for name in (*self._columns, "eps")}
            T_s = self.T_ns * NS
            try:
                start, end = (number * PIECE - 0.5) * T_s, ((number + 1) * PIECE - 0.5) * T_s
                frame = self._frame or load(self.path, max(start, 0.0), end)
                table = frame.select("t", *dict.fromkeys(self._columns.values()))
                k = np.rint(table["t"] / T_s).astype(np.int64) - number * PIECE
                inside = (k >= 0) & (k < PIECE)
                for name, column in self._columns.items():
                    columns[name][k[inside]] = table[column][inside]
            except BagError:
                pass  # a hole
            known = self._eps[number * PIECE : (number + 1) * PIECE]
            columns["eps"][: len(known)] = known
            self._pieces[number] = columns
            if len(self._pieces) > KEPT:
                self._pieces.popitem(last=False)
            return columns


def limits_of(plant: Mapping[str, object]) -> tuple[float, float] | None:
    """Limits of the voltage (V) among a plant's parameters; None where they are none."""
    low, high = number(plant.get("voltage_min")), number(plant.get("voltage_max"))
    return None if low is None or high is None else (low, high)


def _flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Values as nodes name them, ``hysteresis.type``, of those that a recording nests."""
    found: dict[str, Any] = {}
    for name, value in values.items():
        if isinstance(value, dict):
            found |= _flat(value, f"{prefix}{name}.")
        else:
            found[prefix + name] = value
    return found


def permitted_of(plant: Mapping[str, object]) -> tuple[float, ...]:
    """Corners x, y (um) of the permitted area among a plant's parameters; none: it has none."""
    told = plant.get("stage.permitted_um")
    corners = [number(each) for each in told] if isinstance(told, tuple | list) else []
    return tuple(each for each in corners if each is not None)


class Recordings:
    """The recordings that may be opened: those in a folder, and one that was named.

    Each goes by a text that can be shown, whatever its path is.

    Parameters
    ----------
    folder : Path
        Where runs are.
    named : str
        A path; empty: none.

    Attributes
    ----------
    named : str
        The text of the one that was named; empty: none.
    """

    def __init__(self, folder: Path, named: str = "") -> None:
        self.folder = folder
        self.path = named
        self.named = plain(named)
        self._open: dict[tuple[str, str], RecordedTrace] = {}

    @property
    def paths(self) -> dict[str, Path]:
        """All, the newest first, by their texts."""
        found = {self.named: Path(self.path)} if self.path else {}
        for path in sorted(_bags(self.folder), key=_time, reverse=True):
            text = name = plain(path)
            for another in itertools.count(2):
                if name not in found:
                    break
                name = f"{text} ({another})"
            found[name] = path
        return found

    @property
    def names(self) -> list[str]:
        """Texts of all, the newest first."""
        return list(self.paths)

    def open(self, name: str, axis: str = "") -> RecordedTrace:
        """One of `names`; of several axes the one that is shown, empty: the first.

        Raises
        ------
        BagError
            There is none of that name, or it cannot be read.
        """
        if (name, axis) not in self._open:
            path = self.paths.get(name)
            if path is None:
                raise BagError(f"{plain(name)}: not one of the recordings here")
            self._open = {(name, axis): RecordedTrace(path, axis)}
        return self._open[name, axis]


def _bags(folder: Path) -> list[Path]:
    """Folders with a recording, as far as they can be looked into."""
    found = []
    with contextlib.suppress(OSError):
        for path in folder.iterdir():
            with contextlib.suppress(OSError):
                if path.is_dir() and not path.is_symlink() and any(path.glob("*.mcap")):
                    found.append(path)
    return found


def _time(path: Path) -> float:
    try:
        return path.stat().st_mtime
    except OSError:
        return 0.0
