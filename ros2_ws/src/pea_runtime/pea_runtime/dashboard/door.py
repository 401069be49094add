"""Who may come in: pages of this dashboard alone, and from elsewhere only with the token."""

from __future__ import annotations

import hmac
import ipaddress
import secrets
from collections.abc import Awaitable, Callable, Mapping, MutableMapping
from http.cookies import SimpleCookie
from typing import Any
from urllib.parse import parse_qs, urlsplit

COOKIE = "pea_token"

REFUSED = b"pea dashboard: open the address that it has printed; it has the token.\n"

Scope = MutableMapping[str, Any]
Application = Callable[[Scope, Any, Any], Awaitable[None]]


def is_loopback(host: str) -> bool:
    """Whether an address is of this machine alone."""
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return host == "localhost"


def _address(url: str) -> tuple[str, int | None]:
    """Host and port of an address."""
    split = urlsplit(url)
    return split.hostname or "", split.port


class Door:
    """Decides on requests.

    Parameters
    ----------
    host : str
        Address that is listened on.
    port : int
        Port of the page.
    token : str
        What must be shown; empty: nothing, which is for loopback.
    """

    def __init__(self, host: str, port: int, token: str = "") -> None:
        self.host = host
        self.port = port
        self.token = token or ("" if is_loopback(host) else secrets.token_urlsafe(24))

    def open_to(self, headers: Mapping[str, str], query: str = "") -> bool:
        """Whether a request may pass.

        Another page's script is kept out by its Origin, and a name that another page has bent to
        this machine by its Host.

        Parameters
        ----------
        headers : mapping of str to str
            By lower-case name.
        query : str
            Of the address.
        """
        try:
            host, port = _address(f"//{headers.get('host', '')}")
            origin = _address(headers.get("origin", f"//{headers.get('host', '')}"))
        except ValueError:
            return False
        if origin not in ((host, port), (host, self.port)):  # the stop is asked from the page's
            return False
        if not self.token:
            return is_loopback(host) or host == self.host
        return self._shown(headers, query)

    def _shown(self, headers: Mapping[str, str], query: str) -> bool:
        """Whether the token is shown: by cookie, in the address, or as a bearer's."""
        cookies = SimpleCookie(headers.get("cookie", ""))
        told = [cookies[COOKIE].value] if COOKIE in cookies else []
        told += parse_qs(query).get("token", [])
        told.append(headers.get("authorization", "").removeprefix("Bearer "))
        return any(hmac.compare_digest(each.encode(), self.token.encode()) for each in told)


class Guarded:
    """An application behind a door.

    Parameters
    ----------
    app : ASGI application
    door : Door
    """

    def __init__(self, app: Application, door: Door) -> None:
        self.app = app
        self.door = door

    async def __call__(self, scope: Scope, receive: Any, send: Any) -> None:
        """Serve a request, or refuse it."""
        if scope["type"] not in ("http", "websocket"):
            await self.app(scope, receive, send)
            return
        headers = {
            name.decode().lower(): value.decode("latin-1") for name, value in scope["headers"]
        }
        query = scope["query_string"].decode("latin-1")
        if not self.door.open_to(headers, query):
            await _refuse(scope, send)
        elif scope["type"] == "http" and self.door.token and "token" in parse_qs(query):
            await _welcome(scope, send, self.door.token)
        else:
            await self.app(scope, receive, send)


async def _refuse(scope: Scope, send: Any) -> None:
    if scope["type"] == "websocket":
        await send({"type": "websocket.close", "code": 4403})
        return
    kind = [(b"content-type", b"text/plain; charset=utf-8")]
    await send({"type": "http.response.start", "status": 403, "headers": kind})
    await send({"type": "http.response.body", "body": REFUSED})


async def _welcome(scope: Scope, send: Any, token: str) -> None:
    """Keep the token in a cookie, and take it out of the address."""
    cookie = f"{COOKIE}={token}; Path=/; HttpOnly; SameSite=Strict"
    headers = [(b"location", scope["path"].encode()), (b"set-cookie", cookie.encode())]
    await send({"type": "http.response.start", "status": 303, "headers": headers})
    await send({"type": "http.response.body", "body": b""})
