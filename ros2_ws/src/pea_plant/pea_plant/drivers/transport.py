"""Ways to a device for bytes: TCP, a serial line; addresses as text.

========================================== =================================================
``tcp://127.0.0.1:50000``                  TCP; nothing is sent anywhere else
``serial:/dev/ttyUSB0?baud=115200``        serial line, 8N1; also a pty
``serial:/dev/ttyUSB0?xonxoff=true``       the same, the device may ask for silence
========================================== =================================================
"""

from __future__ import annotations

import os
import select
import socket
from typing import Any, Protocol
from urllib.parse import parse_qsl, urlsplit

from pea_core.params import ParameterError, nearest
from pea_plant.drivers.claim import Claim, claim
from pea_plant.drivers.driver import DriverError

BAUD = 115_200
SIZE = 4096
"""Bytes taken at a time."""

FORMS = "tcp://HOST:PORT or serial:/dev/NAME?baud=N"


class Transport(Protocol):
    """A way for bytes, open.

    Attributes
    ----------
    address : str
        As it was given.
    timeout : float
        For each send and receive (s); may be changed.
    """

    address: str
    timeout: float

    def send(self, data: bytes) -> None:
        """Send all of it.

        Raises
        ------
        DriverError
            Not within the time-out, or the way is gone.
        """

    def receive(self) -> bytes:
        """Wait for bytes and return what is there, one at least.

        Raises
        ------
        DriverError
            Nothing within the time-out, or the way is gone.
        """

    def drop(self) -> None:
        """Forget what has come and was not taken."""

    def fileno(self) -> int:
        """File descriptor."""

    def close(self) -> None:
        """Close it; may be called twice."""


class Tcp:
    """A TCP connection; small packets leave at once.

    Parameters
    ----------
    address : str
        As the user gave it.
    host : str
    port : int
    timeout : float
        For each send and receive (s).
    patience : float
        For the connection (s).

    Raises
    ------
    ParameterError
        Nobody there, or another process drives it.
    """

    def __init__(self, address: str, host: str, port: int, timeout: float, patience: float) -> None:
        self.address = address
        try:
            self._socket = socket.create_connection((host, port), patience)
            self._claim: Claim | None = claim(address, f"tcp {self._socket.getpeername()[:2]}")
        except OSError as error:
            raise ParameterError(
                f"address = {address!r}: {_reason(error)}; is the device on, its address right "
                "and nobody else connected?"
            ) from None
        except ParameterError:
            self._socket.close()
            raise
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.timeout = timeout

    @property
    def timeout(self) -> float:
        """For each send and receive (s)."""
        return self._socket.gettimeout() or 0.0

    @timeout.setter
    def timeout(self, seconds: float) -> None:
        self._socket.settimeout(seconds)

    def send(self, data: bytes) -> None:
        """Send all of it."""
        try:
            self._socket.sendall(data)
        except OSError as error:
            raise self._lost(error) from None

    def receive(self) -> bytes:
        """Wait for bytes and return what is there."""
        try:
            data = self._socket.recv(SIZE)
        except TimeoutError:
            raise silent(self.address, self.timeout) from None
        except OSError as error:
            raise self._lost(error) from None
        if not data:
            raise closed(self.address)
        return data

    def drop(self) -> None:
        """Forget what has come and was not taken."""
        while select.select([self._socket], [], [], 0.0)[0]:
            self.receive()

    def fileno(self) -> int:
        """File descriptor."""
        return self._socket.fileno()

    def close(self) -> None:
        """Close it."""
        self._socket.close()
        self._claim = None

    def _lost(self, error: OSError) -> DriverError:
        return DriverError(f"{self.address}: {_reason(error)}; check the cable and the device")


class Serial:
    """A serial line, 8 data bits, no parity, one stop bit.

    Parameters
    ----------
    address : str
        As the user gave it.
    path : str
        Device file.
    baud : int
    xonxoff : bool
        Whether the device may ask for silence.
    timeout : float
        For each send and receive (s).

    Raises
    ------
    ParameterError
        No such line, or another process drives it.
    """

    def __init__(self, address: str, path: str, baud: int, xonxoff: bool, timeout: float) -> None:
        import serial

        self.address = address
        self.timeout = timeout
        self._claim: Claim | None = claim(address, f"serial {os.path.realpath(path)}")
        try:
            self._line = serial.Serial(
                path, baud, xonxoff=xonxoff, timeout=0, write_timeout=timeout
            )
        except (OSError, ValueError) as error:
            raise ParameterError(
                f"address = {address!r}: {_reason(error)}; is the device plugged in, and may you "
                "read and write its file?"
            ) from None

    def send(self, data: bytes) -> None:
        """Send all of it."""
        import serial

        try:
            self._line.write(data)
        except serial.SerialTimeoutException:
            raise silent(self.address, self.timeout) from None
        except OSError as error:
            raise self._lost(error) from None

    def receive(self) -> bytes:
        """Wait for bytes and return what is there."""
        try:
            if not select.select([self._line], [], [], self.timeout)[0]:
                raise silent(self.address, self.timeout)
            data = os.read(self._line.fileno(), SIZE)
        except OSError as error:
            raise self._lost(error) from None
        if not data:
            raise closed(self.address)
        return data

    def drop(self) -> None:
        """Forget what has come and was not taken."""
        self._line.reset_input_buffer()

    def fileno(self) -> int:
        """File descriptor."""
        return int(self._line.fileno()) if self._line.is_open else -1

    def close(self) -> None:
        """Close it."""
        self._line.close()
        self._claim = None

    def _lost(self, error: OSError) -> DriverError:
        return DriverError(f"{self.address}: {_reason(error)}; check the cable and the device")


def connect(address: str, timeout: float, patience: float = 2.0) -> Transport:
    """Open the way that an address names.

    Parameters
    ----------
    address : str
        See the head of this module.
    timeout : float
        For each send and receive (s).
    patience : float
        For a TCP connection to come about (s).

    Raises
    ------
    ParameterError
        Not an address, or nothing there; one line.
    """
    kind, place, options = parse(address)
    if kind == "tcp":
        host, port = place
        return Tcp(address, host, port, timeout, patience)
    return Serial(address, place, options["baud"], options["xonxoff"], timeout)


def parse(address: str) -> tuple[str, Any, dict[str, Any]]:
    """Kind, place and options of an address.

    Returns
    -------
    tuple
        ``"tcp", (host, port), {}`` or ``"serial", path, {"baud": …, "xonxoff": …}``.

    Raises
    ------
    ParameterError
        Not an address; one line.
    """
    wrong = f"address = {address!r}: "
    kind, colon, rest = address.partition(":")
    if not colon or kind not in ("tcp", "serial"):
        raise ParameterError(wrong + f"give {FORMS}")
    if kind == "tcp":
        try:
            url = urlsplit(address)
            host, port = url.hostname, url.port
        except ValueError:
            host, port = None, None
        if not host or not port or url.path or url.query or url.username or url.fragment:
            raise ParameterError(wrong + "give tcp://HOST:PORT, the port 1 to 65535")
        return kind, (host, port), {}
    path, _, query = rest.partition("?")
    if not path.startswith("/"):
        raise ParameterError(wrong + "give serial:/dev/NAME, the whole path")
    options: dict[str, Any] = {"baud": BAUD, "xonxoff": False}
    for name, value in parse_qsl(query, keep_blank_values=True):
        if name not in options:
            raise ParameterError(wrong + f"unknown option {name!r}: {nearest(name, options)}")
        if name == "baud":
            if not (value.isdecimal() and 50 <= int(value) <= 4_000_000):
                raise ParameterError(wrong + f"baud {value!r}: give 50 to 4000000")
            options[name] = int(value)
        else:
            if value not in ("true", "false"):
                raise ParameterError(wrong + f"xonxoff {value!r}: give true or false")
            options[name] = value == "true"
    return kind, path, options


def silent(address: str, timeout: float) -> DriverError:
    """No answer in time."""
    return DriverError(
        f"{address}: no answer within {timeout:g} s; check cable, device and driver.timeout_s"
    )


def closed(address: str) -> DriverError:
    """The other side has ended it."""
    return DriverError(f"{address}: the device closed the connection; check it, then start again")


def _reason(error: Exception) -> str:
    text = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return " ".join(str(text).split()).lower()
