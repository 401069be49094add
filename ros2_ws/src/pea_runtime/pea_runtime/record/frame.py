"""A recording as a table: one row a sample, columns with units, parameters beside them."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from pea_core.signals import SAMPLE
from pea_runtime.record.origin import ORIGIN, mapping
from pea_runtime.record.read import BagError, Recording
from pea_runtime.record.read import load as read

UNITS = {
    "t": "s",
    "w": "m",
    "w_dot": "m/s",
    "w_ddot": "m/s^2",
    "y": "m",
    "y_dot": "m/s",
    "u_applied": "V",
    "x1_hat": "m",
    "x2_hat": "m/s",
    "eps_hat": "V",
    "u": "V",
}
"""Unit of each column."""


class Frame:
    """One row a sample.

    Attributes
    ----------
    recording : Recording
        What was read.
    units : dict of str to str
        Unit of each column.
    """

    def __init__(self, recording: Recording) -> None:
        self.recording = recording
        self.units = dict(UNITS)

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the columns."""
        return tuple(UNITS)

    @cached_property
    def t(self) -> np.ndarray:
        """Loop time (s)."""
        t: np.ndarray = self.recording.stamps * 1e-9
        return t

    @property
    def samples(self) -> np.ndarray:
        """(n,) array of `SAMPLE`."""
        return self.recording.samples

    @property
    def T_s(self) -> float:
        """Sample period (s)."""
        return self.recording.T_ns * 1e-9

    @cached_property
    def parameters(self) -> dict[str, dict[str, Any]]:
        """Values that each node was started with; empty where the recording does not say."""
        tree = mapping(self.metadata.get("parameters", ""))
        return {
            str(name).removeprefix("/pea/"): body["ros__parameters"]
            for name, body in tree.items()
            if isinstance(body, dict) and "ros__parameters" in body
        }

    @property
    def metadata(self) -> dict[str, str]:
        """What the recording says of its run: experiment, mode, seed, versions, machine."""
        return self.recording.metadata.get(ORIGIN, {})

    def __len__(self) -> int:
        return len(self.samples)

    def __getitem__(self, column: str) -> np.ndarray:
        if column == "t":
            return self.t
        if column not in UNITS:
            raise KeyError(f"{column!r}: one of {', '.join(UNITS)}")
        values: np.ndarray = self.samples[column]
        return values

    def __iter__(self) -> Iterator[str]:
        return iter(UNITS)

    def to_dict(self) -> dict[str, np.ndarray]:
        """Columns by name."""
        return {name: np.ascontiguousarray(self[name]) for name in UNITS}

    def to_pandas(self) -> Any:
        """A pandas ``DataFrame`` with `t` as index; units, parameters, metadata in ``attrs``.

        Raises
        ------
        BagError
            pandas is not installed.
        """
        pandas = _optional("pandas")
        frame = pandas.DataFrame(self.to_dict()).set_index("t")
        frame.attrs.update(
            units=self.units, parameters=self.parameters, metadata=dict(self.metadata)
        )
        return frame

    def to_csv(self, path: Path) -> None:
        """Write a CSV file; its first line has names and units, its numbers all their digits."""
        head = ",".join(f"{name} [{unit}]" for name, unit in UNITS.items())
        with open(path, "x", encoding="utf-8", newline="") as file:
            file.write(head + "\n")
            for start in range(0, len(self), PIECE):
                part = slice(start, start + PIECE)
                columns = [self.t[part].tolist()]
                columns += [self.samples[name][part].tolist() for name in SAMPLE.names or ()]
                file.writelines(",".join(map(repr, row)) + "\n" for row in zip(*columns))

    def to_mat(self, path: Path) -> None:
        """Write a MATLAB file: a vector a column, and the struct ``pea`` with what goes with it."""
        from scipy.io import savemat

        about = {**self.metadata, "T_s": self.T_s, "units": self.units}
        with open(path, "xb") as file:
            savemat(file, {**self.to_dict(), "pea": about}, oned_as="column", do_compression=True)

    def to_parquet(self, path: Path) -> None:
        """Write a Parquet file, with units as metadata of the columns.

        Raises
        ------
        BagError
            pyarrow is not installed.
        """
        pyarrow = _optional("pyarrow")
        parquet = _optional("pyarrow.parquet")
        fields = [
            pyarrow.field(name, pyarrow.float64(), metadata={"unit": unit})
            for name, unit in UNITS.items()
        ]
        schema = pyarrow.schema(fields, metadata=dict(self.metadata))
        table = pyarrow.table(self.to_dict(), schema=schema)
        with open(path, "xb") as file:
            parquet.write_table(table, file)


PIECE = 10_000
"""Rows of a CSV file that are made at a time."""


def _optional(module: str) -> Any:
    """A library that not everybody has.

    Raises
    ------
    BagError
        It is not installed.
    """
    try:
        return importlib.import_module(module)
    except ImportError:
        library = module.split(".")[0]
        raise BagError(f"{library} is not installed: .ci/env pip install {library}") from None


def load(path: str | Path) -> Frame:
    """Read a recording.

    Parameters
    ----------
    path : str or Path
        A bag's directory, or an MCAP file.

    Raises
    ------
    BagError
        It is no recording, a topic of the loop is missing, or there is no complete sample.
    """
    return Frame(read(Path(path)))
