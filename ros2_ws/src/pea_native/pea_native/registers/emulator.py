"""A card's registers in memory with the simulated stage behind them: `pea emulate registers`."""

from __future__ import annotations

from typing import Any

from pea_native.board import Board, Params

__all__ = ["Params", "make", "port_of"]


def make(plant: Any, params: Params, port: int | None, compiled: bool = False) -> Board:
    """The card, at the file that the rig names.

    Raises
    ------
    ParameterError
        The file is there already, or the card cannot be compiled.
    """
    return Board(plant, params, plant.driver.address, compiled)


def port_of(address: str) -> int:
    """No port: the address is a file."""
    return 0
