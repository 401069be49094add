"""One process drives a device: a second one on this machine is refused before it says a word.

A claim is a name in the system's table of sockets, so it ends with the process that holds it,
however that ends. Within a process it may be held more than once: the guard's connection is the
second.
"""

from __future__ import annotations

import socket
from weakref import WeakValueDictionary

from pea_core.params import ParameterError


class Claim:
    """Held as long as the object is.

    Parameters
    ----------
    address : str
        As the user gave it.
    device : str
        What is claimed: the same for every address of it.

    Raises
    ------
    ParameterError
        Another process holds it.
    """

    def __init__(self, address: str, device: str) -> None:
        self._holder = socket.socket(socket.AF_UNIX)
        try:
            self._holder.bind(f"\0pea {device}"[:100])
        except OSError:
            raise ParameterError(
                f"address = {address!r}: another process of this machine drives it; end that first"
            ) from None

    def __del__(self) -> None:
        self._holder.close()


_HELD: WeakValueDictionary[str, Claim] = WeakValueDictionary()


def claim(address: str, device: str) -> Claim:
    """The claim of this process on a device, see `Claim`."""
    held = _HELD.get(device)
    if held is None:
        held = _HELD[device] = Claim(address, device)
    return held
