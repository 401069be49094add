"""Ways to a device for bytes: TCP, a serial line; addresses as text.

========================================== =================================================
``tcp://127.0.0.1:50000``                  TCP; nothing is sent anywhere else
``serial:/dev/ttyUSB0?baud=115200``        serial line, 8N1; also a pty
``serial:/dev/ttyUSB0?xonxoff=true``       the same, the device may ask for silence
========================================== =================================================
"""

from __future__ import annotations

import importlib
import os
import select
import socket
import threading
import time
from collections.abc import Callable
from typing import Any
from urllib.parse import parse_qsl, urlsplit

from pea_core.claim import Claim, claim
from pea_core.params import ParameterError, nearest
from pea_plant.drivers.driver import DriverError

BAUD = 115_200
SIZE = 4096
"""Bytes taken at a time."""

CLOSING = 0.2
"""Longest wait for a serial line that has to empty itself before it closes (s)."""

FORMS = "tcp://HOST:PORT or serial:/dev/NAME?baud=N"


class Deadline:
    """The instant by which an exchange has to be whole.

    Parameters
    ----------
    seconds : float
        From now on.
    """

    __slots__ = ("_at", "_looked", "seconds")

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds
        self._at = time.monotonic() + seconds
        self._looked = False

    def left(self) -> float | None:
        """Seconds left; None afterwards.

        The first time afterwards it is 0: what has come is taken although this process is late.
        """
        left = self._at - time.monotonic()
        if left > 0.0:
            return left
        if self._looked:
            return None
        self._looked = True
        return 0.0


class Transport:
    """A way for bytes, open, and the deadline of the exchange that is under way.

    Parameters
    ----------
    address : str
        As the user gave it.
    descriptor : int
        Of a socket or a serial line, which does not block.
    close : callable
        Closes it.
    held : Claim
        On the device.

    Attributes
    ----------
    deadline : Deadline
        For all that is sent and received from now on.
    """

    def __init__(
        self,
        address: str,
        descriptor: int,
        close: Callable[[], None],
        held: Claim,
        deadline: Deadline,
    ) -> None:
        self.address = address
        self.deadline = deadline
        self._fd = descriptor
        self._close = close
        self._claim: Claim | None = held
        self._broken = False
        self._input, self._output = select.poll(), select.poll()
        self._input.register(descriptor, select.POLLIN)
        self._output.register(descriptor, select.POLLOUT)

    def send(self, data: bytes) -> None:
        """Send all of it.

        Raises
        ------
        DriverError
            Not before the deadline, or the way is gone. After a part was sent, nothing more is:
            the device could take it for the rest.
        """
        if self._broken:
            raise self._wrong("a request broke off halfway; close the connection, then start again")
        view = memoryview(data)
        while view:
            try:
                view = view[os.write(self._fd, view) :]
            except BlockingIOError:
                left = self.deadline.left()
                if left is None or not self._output.poll(left * 1e3):
                    self._broken = len(view) < len(data)
                    raise self._wrong(
                        f"takes no request within {self.deadline.seconds:g} s; check cable, device "
                        "and driver.timeout_s"
                    ) from None
            except OSError as error:
                raise self._lost(error) from None

    def receive(self) -> bytes:
        """Wait for bytes and return what is there.

        Returns
        -------
        bytes
            One at least.

        Raises
        ------
        DriverError
            Nothing before the deadline, or the way is gone.
        """
        while True:
            left = self.deadline.left()
            if left is None or not self._input.poll(left * 1e3):
                raise self._wrong(
                    f"no answer within {self.deadline.seconds:g} s; check cable, device and "
                    "driver.timeout_s"
                )
            try:
                data = os.read(self._fd, SIZE)
            except BlockingIOError:
                continue
            except OSError as error:
                raise self._lost(error) from None
            if not data:
                raise self._wrong("the device closed the connection; check it, then start again")
            return data

    def comes_within(self, seconds: float) -> bool:
        """Whether something comes so soon, or has come and was not taken; or the way is gone."""
        return bool(self._input.poll(seconds * 1e3))

    def drop(self) -> None:
        """Forget what has come and was not taken.

        Raises
        ------
        DriverError
            It does not end before the deadline, or the way is gone.
        """
        while self.comes_within(0.0):
            self.receive()

    def fileno(self) -> int:
        """File descriptor, -1 once it is closed."""
        return self._fd

    def close(self) -> None:
        """Close it; may be called twice."""
        if self._fd >= 0:
            self._fd = -1
            self._close()
            self._claim = None

    def _wrong(self, what: str) -> DriverError:
        return DriverError(f"{self.address}: {what}")

    def _lost(self, error: OSError) -> DriverError:
        return self._wrong(f"{_reason(error)}; check the cable and the device")


def connect(address: str, deadline: Deadline) -> Transport:
    """Open the way that an address names, before a deadline.

    Parameters
    ----------
    address : str
        See the head of this module.
    deadline : Deadline
        For this, and for what is sent and received until there is another.

    Raises
    ------
    ParameterError
        Not an address, nothing there, or another process drives it; one line.
    """
    kind, place, options = parse(address)
    if kind == "tcp":
        return _tcp(address, place[0], place[1], deadline)
    return _serial(address, place, options, deadline)


def _tcp(address: str, host: str, port: int, deadline: Deadline) -> Transport:
    """A TCP connection; small packets leave at once."""
    error: OSError = TimeoutError()
    try:
        places = _resolved(host, port, deadline)
    except OSError as unknown:
        places, error = [], unknown
    for family, place in places:
        left = deadline.left()
        if left is None:
            break
        held = claim(address, "tcp", place[:2])
        way = socket.socket(family)
        try:
            way.settimeout(max(left, 1e-3))
            way.connect(place)
            way.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            way.setblocking(False)
        except OSError as refused:
            way.close()
            error = refused
        else:
            return Transport(address, way.fileno(), way.close, held, deadline)
    said = _reason(error)
    if isinstance(error, TimeoutError):
        said = f"nobody answers within {deadline.seconds:g} s"
    raise ParameterError(
        f"address = {address!r}: {said}; is the device on, its address right and nobody else "
        "connected?"
    )


def _resolved(host: str, port: int, deadline: Deadline) -> list[tuple[Any, Any]]:
    """Families and places of a name; a name server that is silent is not waited for longer.

    Raises
    ------
    OSError
        Unknown name, or no answer in time.
    """
    found: list[list[Any] | OSError] = []

    def resolve() -> None:
        try:
            found.append(socket.getaddrinfo(host, port, type=socket.SOCK_STREAM))
        except OSError as error:
            found.append(error)
        except UnicodeError:  # a label that is empty or too long
            found.append(OSError(f"{host!r} is no name of a host"))

    resolver = threading.Thread(target=resolve, daemon=True)
    resolver.start()
    resolver.join(deadline.left() or 0.0)
    if not found:
        raise TimeoutError
    (answer,) = found
    if isinstance(answer, OSError):
        raise answer
    return [(family, place) for family, _, _, _, place in answer]


def _serial(address: str, path: str, options: dict[str, object], deadline: Deadline) -> Transport:
    """A serial line: 8 data bits, no parity, one stop bit."""
    import serial

    try:
        held = claim(address, "serial", path)
        line = serial.Serial(path, options["baud"], xonxoff=options["xonxoff"], timeout=0)
    except (OSError, ValueError) as error:
        raise ParameterError(
            f"address = {address!r}: {_reason(error)}; is the device plugged in, and may you read "
            "and write its file?"
        ) from None

    def close() -> None:
        """Close the line, which waits for its output: without end where the device stops it."""
        closing = threading.Thread(target=line.close, daemon=True)
        closing.start()
        closing.join(CLOSING)

    return Transport(address, line.fileno(), close, held, deadline)


def prepare(address: str) -> None:
    """Import what the way to an address needs; nothing is opened.

    Raises
    ------
    ModuleNotFoundError
        A package is missing.
    """
    if parse(address)[0] == "serial":
        importlib.import_module("serial")


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


def _reason(error: Exception) -> str:
    text = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return " ".join(str(text).split()).lower()
