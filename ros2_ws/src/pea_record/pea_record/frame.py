"""A recording as a table: one row for each sample, columns with units, and the parameters."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import IO, Any

import numpy as np

from pea_core.axes import one_axis
from pea_core.signals import COLUMNS, SIGNAL
from pea_core.units import NS, SECOND
from pea_record.contents import PIECE, Contents, Part
from pea_record.origin import ORIGIN, mapping
from pea_record.read import load_axes as read
from pea_record.read import path_and_axis
from pea_record.recording import BagError, Recording

UNITS = {"t": "s", **{column.name: column.unit for column in COLUMNS}}
"""Unit of each column."""

FOREVER = 2**62
"""A loop time (ns) that no recording reaches."""


LONG = 100_000_000
"""Size (bytes) from which on a recording is read in pieces."""


class Frame:
    """A recording as a table, one row for each sample; a column is read when it is used.

    A long recording, or a part of one, is read in pieces, and only the columns that were used
    stay in memory. `samples` and `recording` read all of it into memory.

    Parameters
    ----------
    path : Path
        A bag's directory, or an MCAP file; ``PATH@AXIS`` for one of several axes.
    start, end : float, optional
        Loop time (s) of the first row, and of the first row past the end.

    Attributes
    ----------
    axes : tuple of str
        Names of the axes. If there are several, the columns of the axis x are ``x.NAME``.
    units : dict of str to str
        Unit of each column, also of added columns.
    recorded : tuple of str
        Names of the columns that were recorded, not added.

    Raises
    ------
    BagError
        It is no recording, a topic of the loop is missing, or there is no complete sample.
    """

    def __init__(self, path: Path, start: float | None = None, end: float | None = None) -> None:
        self.path = path
        self._start, self._end = _nanoseconds(start, 0), _nanoseconds(end, FOREVER)
        if self._end <= self._start:
            raise BagError(f"from {start} s to {end} s: the end must be after the start")
        there, self._axis = path_and_axis(path)
        self._contents = Contents(there)
        self._columns: dict[str, np.ndarray] = {}
        self._apart = self._contents.timed and (
            self._contents.bytes >= LONG or (start, end) != (None, None)
        )
        self.axes = self._named_axes()
        self._fields = {
            (column.name if len(self.axes) == 1 else f"{axis}.{column.name}"): (column, i)
            for i, axis in enumerate(self.axes)
            for column in COLUMNS
        }
        self.units = {"t": UNITS["t"], **{n: c.unit for n, (c, _) in self._fields.items()}}
        if not self._apart:
            self.samples  # noqa: B018  a bad recording is reported at once
        detected = self._contents.detected if self._apart else SIGNAL.name in self._columns
        if detected:
            self.units[SIGNAL.name] = SIGNAL.unit
        self.recorded = tuple(self.units)

    def _named_axes(self) -> tuple[str, ...]:
        """Axes of the table: those of the recording, or the one that the path names."""
        if not self._apart:
            return self.recording.axes
        found = self._contents.axes
        if self._axis and self._axis not in found:
            raise BagError(f"{self.path}: no axis {self._axis!r}: the axes are {', '.join(found)}")
        return (self._axis,) if self._axis else found

    def _column(self, samples: np.ndarray, name: str) -> np.ndarray:
        """A recorded column of some samples."""
        column, i = self._fields[name]
        found: np.ndarray = one_axis(samples, i)[column.name]
        return found

    @cached_property
    def recording(self) -> Recording:
        """The whole recording: samples, changes of parameters, counts, damage."""
        return read(self.path)

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the columns."""
        return tuple(self.units)

    def add(self, name: str, unit: str, values: np.ndarray) -> None:
        """Add a column of one number for each sample, for example a true state of the plant.

        Raises
        ------
        ValueError
            A column has this name, or the length is wrong.
        """
        if name in self.units or len(values) != len(self):
            raise ValueError(f"{name!r}: exists already, or does not have {len(self)} values")
        self.units[name] = unit
        self._columns[name] = values

    @cached_property
    def samples(self) -> np.ndarray:
        """(n,) array of `SAMPLE`; with several axes (n, axes)."""
        if self._apart:
            return np.concatenate([part.samples for part in self._pieces()])
        recording = self.recording
        inside = slice(*np.searchsorted(recording.stamps, (self._start, self._end)))
        if inside.stop == inside.start:
            raise BagError(
                f"{self.path} holds no sample from {self._start * NS:g} s to "
                f"{self._end * NS:g} s: it has those from {recording.first * NS:g} s to "
                f"{recording.last * NS:g} s"
            )
        self._columns["t"] = recording.stamps[inside] * NS
        if recording.signal is not None:
            self._columns[SIGNAL.name] = recording.signal[inside]
        samples: np.ndarray = recording.samples[inside]
        return samples

    def _pieces(self) -> Iterator[Part]:
        """Stamps (ns), samples and sample signal, a piece at a time."""
        found = self._contents.pieces(self._start, self._end)
        if not self._axis or len(self._contents.axes) == 1:
            return found
        i = self._contents.axes.index(self._axis)
        return (part._replace(samples=one_axis(part.samples, i)) for part in found)

    def pieces(self, *columns: str) -> Iterator[dict[str, np.ndarray]]:
        """Columns by name (default: all), in pieces of `contents.PIECE` rows."""
        names = self._named(columns)
        if not self._apart:
            for start in range(0, len(self), PIECE):
                yield {name: self[name][start : start + PIECE] for name in names}
            return
        row = 0
        for stamps, samples, signal in self._pieces():
            until = row + len(stamps)
            table = {n: self._columns[n][row:until] for n in names if n not in self.recorded}
            if "t" in names:
                table["t"] = stamps * NS
            if signal is not None:
                table[SIGNAL.name] = signal
            yield {n: table[n] if n in table else self._column(samples, n) for n in names}
            row = until

    def select(self, *columns: str) -> dict[str, np.ndarray]:
        """Columns by name (default: all), in one pass over the recording.

        Raises
        ------
        KeyError
            There is no such column.
        """
        names = self._named(columns)
        if "samples" in self.__dict__:
            for name in names:
                if name in self._fields:
                    column = np.ascontiguousarray(self._column(self.samples, name))
                    self._columns.setdefault(name, column)
        lacking = [name for name in names if name not in self._columns]
        if lacking:
            parts = list(self.pieces(*lacking))
            for name in lacking:
                self._columns[name] = np.concatenate([part.pop(name) for part in parts])
        return {name: self._columns[name] for name in names}

    def _named(self, columns: tuple[str, ...]) -> tuple[str, ...]:
        for name in columns:
            if name not in self.units:
                raise KeyError(f"{name!r}: one of {', '.join(self.units)}")
        return columns or tuple(self.units)

    @property
    def t(self) -> np.ndarray:
        """Loop time (s)."""
        return self["t"]

    @property
    def T_s(self) -> float:
        """Sample period (s)."""
        return (self._contents.T_ns or self.recording.T_ns) * NS

    @cached_property
    def parameters(self) -> dict[str, dict[str, Any]]:
        """Values with which each node was started; empty if the recording has none."""
        tree = mapping(self.metadata.get("parameters", ""))
        return {
            str(name).removeprefix("/pea/"): body["ros__parameters"]
            for name, body in tree.items()
            if isinstance(body, dict) and "ros__parameters" in body
        }

    @property
    def metadata(self) -> dict[str, str]:
        """Recorded facts about the run: experiment, mode, seed, versions, machine."""
        return self._contents.metadata.get(ORIGIN, {})

    @property
    def damage(self) -> str:
        """What could not be read so far, in one line; empty if there is no damage."""
        if not self._apart:
            return self.recording.damage
        return "; ".join(self._contents.damages)

    def __repr__(self) -> str:
        return f"<recording {self.path}: {len(self)} samples>"

    def __len__(self) -> int:
        return len(self.t)

    def __getitem__(self, column: str) -> np.ndarray:
        return self.select(column)[column]

    def __iter__(self) -> Iterator[str]:
        return iter(self.units)

    def to_pandas(self, *columns: str) -> Any:
        """A pandas ``DataFrame`` with `t` as index; units, parameters, metadata in ``attrs``.

        Parameters
        ----------
        *columns : str
            Columns to include; default: all.
        """
        import pandas

        wanted = tuple(name for name in self._named(columns) if name != "t")
        table = self.select("t", *wanted)
        frame = pandas.DataFrame(table).set_index("t")
        frame.attrs.update(
            units=self.units, parameters=self.parameters, metadata=dict(self.metadata)
        )
        return frame

    def to_xarray(self, *columns: str) -> Any:
        """An xarray ``Dataset`` along `t`; units in the attributes of each variable.

        Of a long recording only `t` is read now. A variable is read from the file when its rows
        are used, and only for these rows.

        Parameters
        ----------
        *columns : str
            Columns to include; default: all.
        """
        import xarray

        from pea_record.lazy import variable

        wanted = [name for name in self._named(columns) if name != "t"]
        if self._apart:
            data = {name: variable(self, name) for name in wanted}
        else:
            data = {name: xarray.Variable("t", self[name]) for name in wanted}
        for name, column in data.items():
            column.attrs["units"] = self.units[name]
        about = {**self.metadata, "T_s": self.T_s}
        found = xarray.Dataset(data, {"t": ("t", self["t"], {"units": "s"})}, about)
        found["t"].attrs["long_name"] = "loop time"
        return found

    def to_hdf5(self, path: Path) -> None:
        """Write an HDF5 file: a data set for each column, its unit in the attribute ``units``."""
        import h5py

        with _new(path, "xb"), h5py.File(path, "w") as file:
            file.attrs.update({**self.metadata, "T_s": self.T_s})
            for name, unit in self.units.items():
                made = file.create_dataset(name, (len(self),), "f8", compression="gzip")
                made.attrs["units"] = unit
            row = 0
            for table in self.pieces():
                until = row + len(table["t"])
                for name, values in table.items():
                    file[name][row:until] = values
                row = until

    def to_netcdf(self, path: Path) -> None:
        """Write a netCDF 4 file, which `xarray.open_dataset` reads."""
        with _new(path, "xb"):
            self.to_xarray().to_netcdf(path, engine="h5netcdf")

    def to_csv(self, path: Path) -> None:
        """Write a CSV file: names and units in the first line, then numbers with all digits."""
        head = ",".join(f"{name} [{unit}]" for name, unit in self.units.items())
        with _new(path, "x", encoding="utf-8", newline="") as file:
            file.write(head + "\n")
            for table in self.pieces():
                rows = zip(*(column.tolist() for column in table.values()))
                file.writelines(",".join(map(repr, row)) + "\n" for row in rows)

    def to_mat(self, path: Path) -> None:
        """Write a MATLAB file: a vector for each column; metadata and units in the struct ``pea``.

        If there are several axes, each is a struct, so that a column is ``x.y`` there, too.
        """
        from scipy.io import savemat

        about = {**self.metadata, "T_s": self.T_s, "units": _nested(self.units)}
        table = _nested(self.select())
        with _new(path, "xb") as file:
            savemat(file, {**table, "pea": about}, oned_as="column", do_compression=True)

    def to_parquet(self, path: Path) -> None:
        """Write a Parquet file, with units as metadata of the columns."""
        import pyarrow
        from pyarrow.parquet import ParquetWriter

        fields = [
            pyarrow.field(name, pyarrow.float64(), metadata={"unit": unit})
            for name, unit in self.units.items()
        ]
        schema = pyarrow.schema(fields, metadata=dict(self.metadata))
        with _new(path, "xb") as file, ParquetWriter(file, schema) as writer:
            for table in self.pieces():
                writer.write_table(pyarrow.table(table, schema=schema))


def _nested(values: Mapping[str, Any]) -> dict[str, Any]:
    """The values, with those named ``x.NAME`` collected in a mapping ``x``."""
    found: dict[str, Any] = {}
    for name, value in values.items():
        axis, dot, own = name.partition(".")
        if dot:
            found.setdefault(axis, {})[own] = value
        else:
            found[name] = value
    return found


@contextlib.contextmanager
def _new(path: Path, mode: str, **options: Any) -> Iterator[IO[Any]]:
    """A new file; it is removed again if writing fails."""
    with open(path, mode, **options) as file:
        try:
            yield file
        except BaseException:
            Path(path).unlink(missing_ok=True)
            raise


def _nanoseconds(seconds: float | None, otherwise: int) -> int:
    if seconds is None:
        return otherwise
    if not 0.0 <= seconds <= FOREVER * NS:
        raise BagError(f"{seconds} s: a part begins and ends at 0 s or later")
    return round(seconds * SECOND)


def load(path: str | Path, start: float | None = None, end: float | None = None) -> Frame:
    """Open a recording, or the part of it from `start` to before `end` (s of loop time): `Frame`.

    Raises
    ------
    BagError
        It is no recording, a topic of the loop is missing, or there is no complete sample.
    """
    return Frame(Path(path), start, end)
