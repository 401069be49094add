"""Columns of a long recording for xarray: read from the file, for the rows that are asked for."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import xarray
from xarray.backends import BackendArray
from xarray.core import indexing

if TYPE_CHECKING:
    from pea_record.frame import Frame


class _Column(BackendArray):
    """One column; rows are found by their stamps."""

    def __init__(self, frame: Frame, name: str) -> None:
        self._frame, self._name = frame, name
        self.shape = (len(frame),)
        self.dtype = np.dtype(np.float64)

    def __getitem__(self, key: Any) -> Any:
        basic = indexing.IndexingSupport.BASIC
        return indexing.explicit_indexing_adapter(key, self.shape, basic, self._rows)

    def _rows(self, key: tuple[Any, ...]) -> Any:
        rows = range(self.shape[0])[key[0]]
        if isinstance(rows, int):
            return self._between(rows, rows + 1)[0]
        if not rows:
            return np.empty(0)
        low, high = min(rows[0], rows[-1]), max(rows[0], rows[-1])
        found = self._between(low, high + 1)
        return found[np.asarray(rows) - low]

    def _between(self, first: int, end: int) -> np.ndarray:
        frame = self._frame
        half = 0.5 * frame.T_s
        part = type(frame)(frame.path, max(frame.t[first] - half, 0.0), frame.t[end - 1] + half)
        return part[self._name]


def variable(frame: Frame, name: str) -> Any:
    """A column as an xarray ``Variable`` that has read nothing yet."""
    if name not in frame.recorded:
        return xarray.Variable("t", frame[name])
    return xarray.Variable("t", indexing.LazilyIndexedArray(_Column(frame, name)))
