"""A board over UDP with the simulated stage in it, in real time: `pea emulate udp`."""

from __future__ import annotations

from typing import Any

from pea_core.params import ParameterError
from pea_drivers.emulator import LOOPBACK
from pea_native.board import Board, Params

__all__ = ["Params", "make", "port_of"]


def make(plant: Any, params: Params, port: int | None, compiled: bool = False) -> Board:
    """The board, which listens on a port of the loopback interface; 0: any.

    Raises
    ------
    ParameterError
        The port is taken, or the board cannot be compiled.
    """
    if port is None:
        raise ParameterError("--pty: a board over UDP has no line; leave it out")
    return Board(plant, params, f"udp://{LOOPBACK}:{port}", compiled)


def port_of(address: str) -> int:
    """Port of an address.

    Raises
    ------
    ParameterError
        It has none.
    """
    port = address.rpartition(":")[2]
    if not address.startswith("udp://") or not port.isdecimal() or int(port) > 65535:
        raise ParameterError(f"driver.address = {address!r}: write udp://HOST:PORT")
    return int(port)
