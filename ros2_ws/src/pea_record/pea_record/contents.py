"""What is where in a long recording, so that a part of it is read without the rest."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pea_core.config import AXIS
from pea_core.loop import CHUNK
from pea_core.units import NS
from pea_record.origin import ORIGIN
from pea_record.raw_records import Place
from pea_record.read import files_of
from pea_record.recording import BagError
from pea_record.tape import Tape
from pea_wire.topics import REFERENCE, SAMPLED, SIGNAL

PIECE = 100_000
"""Samples that are read at a time."""

BEFORE = 4 * CHUNK
"""Samples of loop time before a part in whose chunks its reference is looked for first."""


class Part(NamedTuple):
    """Samples of a recording that follow each other.

    Attributes
    ----------
    stamps : (n,) array of int64
        Loop time (ns).
    samples : array of `SAMPLE`
        (n,), of several axes (n, axes).
    signal : (n,) array or None
        The sample signal, as of `Recording`.
    """

    stamps: np.ndarray
    samples: np.ndarray
    signal: np.ndarray | None


class Contents:
    """The chunks of a recording by loop time.

    Parameters
    ----------
    path : Path
        A bag's directory, or an MCAP file.

    Attributes
    ----------
    metadata : dict of str to dict
        Records of names and texts, by name.
    places : list of Place
        The chunks.
    T_ns : int
        Sample period (ns); 0 where the recording does not say.
    bytes : int
        Size of the files.
    detected : bool
        Whether there is a sample signal, where the files are complete.
    damages : list of str
        What could not be read of the parts so far, a line each.

    Raises
    ------
    BagError
        It is no recording, or a topic of it is of another type.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.places: list[Place] = []
        self.damages: list[str] = []
        self.bytes = 0
        self._topics: dict[Path, dict[int, str]] = {}
        tape = Tape()
        for file in files_of(path):
            self.places += tape.survey(file)
            self._topics[file] = tape.topics
            self.bytes += file.stat().st_size
        self._indexed = tape.indexed
        self.detected = SIGNAL.name in tape.filled
        self.metadata = tape.metadata
        period = self.metadata.get(ORIGIN, {}).get("sample_period_ns", "")
        self.T_ns = int(period) if period.isdecimal() and len(period) < 19 else 0

    @cached_property
    def axes(self) -> tuple[str, ...]:
        """Names of the axes, from the first chunk that has a measurement."""
        tape = Tape()
        for place in self.places:
            tape.read_chunks(place.file, [place], self._topics[place.file])
            if tape.axes:
                break
        return tape.axes or (AXIS,)

    @property
    def timed(self) -> bool:
        """Whether log times are loop time, as in what pea records, and the files are complete."""
        return bool(self.T_ns and self.places and self._indexed)

    def part(self, start: int, end: int) -> Part:
        """Complete samples from the stamp `start` (ns) to before `end`."""
        for before in (BEFORE * self.T_ns, start):
            tape = Tape()
            self.read(tape, start - before, end + BEFORE * self.T_ns)
            if self._covered(tape, start, end):
                break
        self.damages += [line for line in tape.damages if line not in self.damages]
        stamps, samples = tape.samples()
        inside = slice(*np.searchsorted(stamps, (start, end)))
        signal = tape.signal(stamps[inside]) if self.detected else None
        return Part(stamps[inside], samples[inside], signal)

    def _covered(self, tape: Tape, start: int, end: int) -> bool:
        """Whether no sample is left out for want of a reference that came before."""
        measured = tape.stamps(SAMPLED[0])
        inside = measured[(measured >= start) & (measured < end)]
        known = tape.stamps(REFERENCE)
        return not len(inside) or (len(known) > 0 and bool(known.min() <= inside.min()))

    def read(self, tape: Tape, start: int, end: int) -> None:
        """Read the chunks that hold something from `start` to before `end` (ns of loop time)."""
        chosen: dict[Path, list[Place]] = defaultdict(list)
        for place in self.places:
            if place.last >= start and place.first < end:
                chosen[place.file].append(place)
        for file, places in chosen.items():
            tape.read_chunks(file, places, self._topics[file])

    def pieces(self, start: int, end: int) -> Iterator[Part]:
        """Complete samples from the stamp `start` (ns) to before `end`, `PIECE` at a time.

        Raises
        ------
        BagError
            There is none.
        """
        first = min(place.first for place in self.places)
        last = max(place.last for place in self.places)
        any_at_all = False
        for at in range(max(start, first), min(end, last + 1), PIECE * self.T_ns):
            part = self.part(at, min(at + PIECE * self.T_ns, end))
            if len(part.stamps):
                any_at_all = True
                yield part
        if not any_at_all:
            damage = f": {self.damages[0]}" if self.damages else ""
            raise BagError(
                f"{self.path} holds no whole sample from {start * NS:g} s to {end * NS:g} s: "
                f"it reaches from {first * NS:g} s to {last * NS:g} s{damage}"
            )
