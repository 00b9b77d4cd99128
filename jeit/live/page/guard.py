"""Who may open the page of a live session: hosts, origins and a token are checked before anything is answered."""

from __future__ import annotations

import ipaddress
import secrets
import socket
from urllib.parse import parse_qs, urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

_GUARDED = ("/", "/socket")
"""Paths that need the token; the other files are those of every installation."""

_HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}


def is_loopback(host: str) -> bool:
    """True for a name or address of this machine that no other machine reaches."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _is_address(host: str) -> bool:
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True


def _is_every_address(host: str) -> bool:
    return _is_address(host) and ipaddress.ip_address(host).is_unspecified


def _name(host_header: str) -> str:
    """The host in a header `host[:port]`, in lower case; empty if it is none."""
    try:
        return (urlsplit(f"//{host_header}").hostname or "").rstrip(".")
    except ValueError:
        return ""


def host_allowed(header: str, listening: str) -> bool:
    """Whether a request's host is one that the server at `listening` goes by.

    A page of another site can have its own name point here, and its scripts then reach this server under that name;
    they cannot have the name be an address, nor this machine's own. The port is free, so that a tunnel works.
    """
    name = _name(header)
    if is_loopback(name) or name == listening.lower():
        return True
    if not _is_every_address(listening):
        return False
    own = socket.gethostname().lower()
    return _is_address(name) or name in (own, f"{own.split('.')[0]}.local")


class Guard:
    """Refuse requests for another host, WebSockets from another origin, and pages without the token.

    `host`: address that the server listens on. `token`: what the address must hold as `?token=…`, or None.
    """

    def __init__(self, app: ASGIApp, *, host: str, token: str | None) -> None:
        self._app = app
        self._host = host
        self._token = token

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, or pass it on."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        host = Headers(scope=scope).get("host", "")
        problem = self._problem(scope, host)
        if problem is None:
            await self._app(scope, receive, self._hardened(send, host))
        elif scope["type"] == "websocket":
            await receive()
            await send({"type": "websocket.close", "code": 1008, "reason": problem})
        else:
            await PlainTextResponse(problem + "\n", 403, headers=_HEADERS)(scope, receive, send)

    def _problem(self, scope: Scope, host: str) -> str | None:
        if not host_allowed(host, self._host):
            return "This host name is not one of this server: open the address that `jeit live` prints."
        origin = Headers(scope=scope).get("origin")
        if (origin is not None or scope["type"] == "websocket") and origin not in (f"http://{host}", f"https://{host}"):
            return "Another site's page may not use this server."
        if self._token is not None and scope["path"] in _GUARDED:
            given = parse_qs(scope["query_string"].decode("latin-1")).get("token", [""])[0]
            if not secrets.compare_digest(given.encode(), self._token.encode()):
                return "The token is missing or wrong: open the address that `jeit live` prints, with its ?token=…"
        return None

    @staticmethod
    def _hardened(send: Send, host: str) -> Send:
        """Send with headers by which a browser runs nothing but the page's own files, and in no other site's frame."""
        policy = (
            "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; media-src blob:; "
            f"connect-src 'self' ws://{host} wss://{host}; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
        )

        async def hardened(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                headers.update({**_HEADERS, "Content-Security-Policy": policy})
            await send(message)

        return hardened
