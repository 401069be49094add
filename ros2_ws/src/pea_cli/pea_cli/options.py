"""Options that several commands share: numbers, paths and parameters, checked alike."""

from __future__ import annotations

import argparse
import os
import typing
from pathlib import Path

from pea_core.config import BATCH, CLOCKS, COMPOSED, DISTRIBUTED, MODES, UNPACED, WALL
from pea_core.params import ParameterError, Spec, nearest
from pea_core.paths import given
from pea_core.printable import printable


def number(option: str, text: str, low: float, high: float, unit: str = "") -> float:
    """A number within a range, ends included.

    Raises
    ------
    ParameterError
        It is no number, or out of range; the text names the option, as ``--rate``.
    """
    return typing.cast(float, Spec(unit, low, high).check(option, text))


def whole(option: str, text: str, low: int, high: int) -> int:
    """A whole number within a range; errors as `number`."""
    return typing.cast(int, Spec(low=low, high=high, kind=int).check(option, text))


def path_of(text: str) -> Path:
    """A path, as the type of an option."""
    try:
        return given(text)
    except ParameterError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


DURATION_MIN, DURATION_MAX = 1e-9, 1e6
"""Shortest and longest run (s); an experiment may allow less."""

SEED_MAX = 2**31 - 1


def sets(command: argparse.ArgumentParser) -> None:
    """Add the option that changes parameters of an experiment."""
    command.add_argument(
        "--set",
        metavar="NODE.PARAM=VALUE",
        action="append",
        default=[],
        dest="sets",
        help="change a parameter; may be repeated",
    )


def timed(arguments: argparse.Namespace) -> bool:
    """Choose mode and clock, which by default follow from the rig; return whether it is wall time.

    Raises
    ------
    ParameterError
        Unknown mode or clock, or one that does not fit the rig or the other.
    """
    arguments.mode = arguments.mode or (DISTRIBUTED if arguments.rig else BATCH)
    arguments.clock = arguments.clock or (WALL if arguments.rig else UNPACED)
    for name, known in (("mode", MODES), ("clock", CLOCKS)):
        value = getattr(arguments, name)
        if value not in known:
            raise ParameterError(f"unknown {name} {value!r}: {nearest(value, known)}")
    if arguments.rig and (arguments.mode == BATCH or arguments.clock == UNPACED):
        option = f"--mode {BATCH}" if arguments.mode == BATCH else f"--clock {UNPACED}"
        raise ParameterError(f"{option}: a rig runs on the clock; omit it")
    if arguments.clock == WALL and arguments.mode == BATCH:
        raise ParameterError(
            f"--clock {WALL}: mode {BATCH} has no wall time; add --mode {COMPOSED} or {DISTRIBUTED}"
        )
    return bool(arguments.clock == WALL)


def duration(arguments: argparse.Namespace) -> float | None:
    """Requested loop time (s)."""
    if arguments.duration is None:
        return None
    return number("--duration", arguments.duration, DURATION_MIN, DURATION_MAX, "s")


def seed(arguments: argparse.Namespace) -> int | None:
    """Requested seed of the sensor noise."""
    return None if arguments.seed is None else whole("--seed", arguments.seed, 0, SEED_MAX)


def cpu(arguments: argparse.Namespace) -> int | None:
    """Requested core, one that this process may use."""
    cpus = sorted(os.sched_getaffinity(0))
    known = {str(cpu): cpu for cpu in cpus}
    if arguments.cpu is None or arguments.cpu in known:
        return known.get(arguments.cpu)
    raise ParameterError(f"--cpu {printable(arguments.cpu, 20)}: must be one of {', '.join(known)}")
