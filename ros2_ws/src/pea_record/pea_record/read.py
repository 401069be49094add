"""Reads a recording back, of one axis or of all: its files, its samples, its topics."""

from __future__ import annotations

from pathlib import Path

from pea_record.recording import BagError, Recording
from pea_record.tape import Tape


def load(path: Path) -> Recording:
    """Read a recording of one axis, or one axis of several: ``PATH@AXIS``.

    Raises
    ------
    BagError
        As `load_axes`; it has several axes.
    """
    found = load_axes(path)
    if len(found.axes) > 1:
        raise BagError(
            f"{path} has the axes {', '.join(found.axes)}, and this takes one: write "
            f"{path}@{found.axes[0]}"
        )
    return found


def path_and_axis(path: Path) -> tuple[Path, str]:
    """Path of a recording, and the axis that ``PATH@AXIS`` names; empty where it names none."""
    before, at, axis = path.name.rpartition("@")
    if not at or not before or path.exists():
        return path, ""
    return path.with_name(before), axis


def load_axes(path: Path) -> Recording:
    """Read a recording of any number of axes, or one axis of it: ``PATH@AXIS``.

    Parameters
    ----------
    path : Path
        A bag's directory, or an MCAP file.

    Raises
    ------
    BagError
        It is no recording, a topic of the loop is missing, there is no complete sample, or no such
        axis.
    """
    there, axis = path_and_axis(path)
    tape = Tape()
    for file in files_of(there):
        tape.read(file)
    found = tape.recording(there)
    if axis and axis not in found.axes:
        raise BagError(f"{path}: no axis {axis!r}: the axes are {', '.join(found.axes)}")
    return found.of(axis) if axis else found


def topics(recording: Recording) -> dict[str, dict[str, int]]:
    """What each topic holds: messages, and of the loop's stamps (ns) the first, the last, gaps."""
    told = {}
    for name, count in recording.counts.items():
        told[name] = {"messages": count}
        if name in recording.spans:
            first, last = recording.spans[name]
            told[name] |= {
                "first_ns": first,
                "last_ns": last,
                "gaps": recording.gaps[name],
                "repeats": recording.repeats[name],
            }
    return told


def files_of(path: Path) -> list[Path]:
    """MCAP files of a recording, in order.

    Raises
    ------
    BagError
        There is none.
    """
    if path.is_file():
        return [path]
    if not path.is_dir():
        raise BagError(f"{path} does not exist")
    files = sorted(path.glob("*.mcap"), key=_number)
    if not files:
        raise BagError(f"{path} is no recording: no .mcap file in it")
    return files


def _number(file: Path) -> tuple[str, int]:
    """Name and number of a file of a split recording: 10 comes after 9."""
    name, _, number = file.stem.rpartition("_")
    return (name, int(number)) if number.isdecimal() else (file.stem, -1)
