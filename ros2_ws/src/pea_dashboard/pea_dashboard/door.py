"""Who may come in: pages of this dashboard alone, and from elsewhere only with the token."""

from __future__ import annotations

import hmac
import ipaddress
import secrets
from collections.abc import Mapping
from urllib.parse import parse_qs, urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import cookie_parser
from starlette.responses import HTMLResponse, PlainTextResponse, RedirectResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

COOKIE = "pea_token"

REFUSED = "pea dashboard: open the address that it has printed; it has the token.\n"

LARGEST = 2**20
"""Bytes of a request's body, at most."""

READ_ONLY = ("GET", "HEAD")
"""Methods that change nothing."""

POLICY = {
    "X-Frame-Options": "DENY",
    "Content-Security-Policy": "frame-ancestors 'none'",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "same-origin",
    "X-Content-Type-Options": "nosniff",
}
"""Headers of every answer: no other page may frame, open or embed what is served here."""


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

    def open_to(self, headers: Mapping[str, str], query: str = "", method: str = "GET") -> bool:
        """Whether a request may pass.

        The Origin header keeps out the scripts of other pages, the Host header a foreign name
        that resolves to this machine, the Sec-Fetch headers what a browser sends without an
        Origin: an image, a frame, a form.

        Parameters
        ----------
        headers : mapping of str to str
            By lower-case name.
        query : str
            Of the address.
        method : str
        """
        try:
            host, port = _address(f"//{headers.get('host', '')}")
            origin = _address(headers.get("origin", f"//{headers.get('host', '')}"))
        except ValueError:
            return False
        if origin not in ((host, port), (host, self.port)):  # the stop is asked from the page's
            return False
        if "origin" not in headers and _foreign(headers, method):
            return False
        if not self.token:
            return is_loopback(host) or host == self.host
        return self._shown(headers, query)

    def _shown(self, headers: Mapping[str, str], query: str) -> bool:
        """Whether the token is shown: by cookie, in the address, or as a bearer's."""
        told = [cookie_parser(headers.get("cookie", "")).get(COOKIE, "")]
        told += parse_qs(query).get("token", [])
        told.append(headers.get("authorization", "").removeprefix("Bearer "))
        return any(hmac.compare_digest(each.encode(), self.token.encode()) for each in told)


def _foreign(headers: Mapping[str, str], method: str) -> bool:
    """Whether a browser says that another page has asked; a link that is followed is none."""
    if headers.get("sec-fetch-site", "none") in ("none", "same-origin"):
        return False
    followed = (headers.get("sec-fetch-mode"), headers.get("sec-fetch-dest"))
    return followed != ("navigate", "document") or method not in READ_ONLY


class DoorMiddleware:
    """An application behind a door.

    Parameters
    ----------
    app : ASGI application
    door : Door
    fallback : str
        HTML that is shown where the application fails.
    """

    def __init__(self, app: ASGIApp, door: Door, fallback: str = "") -> None:
        self.app = app
        self.door = door
        self.fallback = fallback

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve a request, or refuse it."""
        if scope["type"] not in ("http", "websocket"):
            await self.app(scope, receive, send)
            return
        raw = Headers(scope=scope)
        headers = {name: ", ".join(raw.getlist(name)) for name in raw}
        query = scope["query_string"].decode("latin-1")
        if not self.door.open_to(headers, query, scope.get("method", "GET")):
            await _refuse(scope, receive, send)
        elif scope["type"] == "websocket":
            await self.app(scope, receive, send)
        elif _too_large(headers):
            await _short(f"a body has {LARGEST} bytes at most\n", 413)(scope, receive, send)
        elif self.door.token and "token" in parse_qs(query):
            await self._welcome()(scope, receive, send)
        else:
            await self._serve(scope, receive, send)

    async def _serve(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve a request; where the application fails, the page that can still stop."""
        started = False

        async def forward(message: Message) -> None:
            nonlocal started
            if message["type"] == "http.response.start":
                started = True
                MutableHeaders(scope=message).update(POLICY)
            await send(message)

        try:
            await self.app(scope, receive, forward)
        except Exception as error:
            if started or not self.fallback:
                raise
            page = self.fallback.replace("{{error}}", type(error).__name__)
            await HTMLResponse(page, 500, POLICY)(scope, receive, send)
            raise

    def _welcome(self) -> RedirectResponse:
        """Keep the token in a cookie, and take it out of the address."""
        answer = RedirectResponse("/", 303)
        answer.set_cookie(COOKIE, self.door.token, httponly=True, samesite="strict")
        return answer


def _too_large(headers: Mapping[str, str]) -> bool:
    """Whether a body is larger than is read here, or does not say how large it is."""
    length = headers.get("content-length", "0")
    return "transfer-encoding" in headers or not length.isdigit() or int(length[:20]) > LARGEST


def _short(text: str, status: int) -> PlainTextResponse:
    """An answer behind which the connection ends: a body that nobody reads goes with it."""
    return PlainTextResponse(text, status, {"Connection": "close", **POLICY})


async def _refuse(scope: Scope, receive: Receive, send: Send) -> None:
    if scope["type"] == "websocket":
        await send({"type": "websocket.close", "code": 4403})
    else:
        await _short(REFUSED, 403)(scope, receive, send)
