"""Numbers and paths behind the options of the commands, checked like any parameter."""

from __future__ import annotations

import argparse
import typing
from pathlib import Path

from pea_core.params import ParameterError, Spec
from pea_core.paths import given


def number(option: str, text: str, low: float, high: float, unit: str = "") -> float:
    """A number within a range, ends included.

    Raises
    ------
    ParameterError
        It is none, or out of range; the text names the option, as ``--rate``.
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
