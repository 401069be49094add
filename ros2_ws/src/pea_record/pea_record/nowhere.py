"""In place of a bag where a run is not to be recorded."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping

import numpy as np

from pea_wire.topics import Topic


class Nowhere(contextlib.nullcontext["Nowhere"]):
    """Takes what a `pea_record.bag.BagWriter` takes, and keeps nothing."""

    def __init__(self) -> None:
        super().__init__(self)

    def metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Take a record of metadata."""

    def write(self, topic: Topic, stamp: int, data: bytes) -> None:
        """Take a message."""

    def write_many(self, topic: Topic, stamps: np.ndarray, rows: np.ndarray) -> None:
        """Take messages of equal size."""

    def keep(self) -> None:
        """Do nothing."""
