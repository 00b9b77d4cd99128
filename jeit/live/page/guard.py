"""Access control of the page of a live session: the host, the origin and a token of each request are checked."""

from __future__ import annotations

import ipaddress
import secrets
import socket
from urllib.parse import parse_qs, urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

_TOKEN_PATHS = ("/", "/socket")
"""Paths that require the token. The other files are the same in every installation."""

_HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}


def is_loopback(host: str) -> bool:
    """Whether a host name or address is a loopback address, which other machines cannot reach."""
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


def _is_unspecified(host: str) -> bool:
    return _is_address(host) and ipaddress.ip_address(host).is_unspecified


def _host_name(host_header: str) -> str:
    """Return the host in a request's header `host[:port]`, in lower case; "" if the header is invalid."""
    try:
        return (urlsplit(f"//{host_header}").hostname or "").rstrip(".")
    except ValueError:
        return ""


def host_allowed(header: str, listening: str) -> bool:
    """Whether the host that a request names in its `header` is a name or address of the server at `listening`.

    The domain name of another site can resolve to this machine, and the scripts of that site then reach this server
    under this domain name (DNS rebinding). The domain name is neither an address nor the name of this machine, so the
    request is refused. Any port is allowed, so that a tunnel works.
    """
    name = _host_name(header)
    if is_loopback(name) or name == listening.lower():
        return True
    if not _is_unspecified(listening):
        return False
    host_name = socket.gethostname().lower()
    return _is_address(name) or name in (host_name, f"{host_name.split('.')[0]}.local")


class Guard:
    """Middleware that refuses requests for another host, WebSockets from another origin, and pages without the token.

    `host`: address that the server listens on. `token`: value of `?token=…` that the address must contain, or None.
    """

    def __init__(self, app: ASGIApp, *, host: str, token: str | None) -> None:
        self._app = app
        self._host = host
        self._token = token

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Refuse a request, or pass the request on to the application."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        host = Headers(scope=scope).get("host", "")
        problem = self._find_problem(scope, host)
        if problem is None:
            await self._app(scope, receive, self._with_security_headers(send, host))
        elif scope["type"] == "websocket":
            await receive()
            await send({"type": "websocket.close", "code": 1008, "reason": problem})
        else:
            await PlainTextResponse(problem + "\n", 403, headers=_HEADERS)(scope, receive, send)

    def _find_problem(self, scope: Scope, host: str) -> str | None:
        if not host_allowed(host, self._host):
            return "This host name is not one of this server: open the address that `jeit live` prints."
        origin = Headers(scope=scope).get("origin")
        if (origin is not None or scope["type"] == "websocket") and origin not in (f"http://{host}", f"https://{host}"):
            return "Another site's page may not use this server."
        if self._token is not None and scope["path"] in _TOKEN_PATHS:
            given_token = parse_qs(scope["query_string"].decode("latin-1")).get("token", [""])[0]
            if not secrets.compare_digest(given_token.encode(), self._token.encode()):
                return "The token is missing or wrong: open the address that `jeit live` prints, with its ?token=…"
        return None

    @staticmethod
    def _with_security_headers(send: Send, host: str) -> Send:
        """Add headers to a response that make the browser run only the page's own files, and not show the page in a
        frame of another site."""
        policy = (
            "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; media-src blob:; "
            f"connect-src 'self' ws://{host} wss://{host}; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
        )

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                headers.update({**_HEADERS, "Content-Security-Policy": policy})
            await send(message)

        return send_with_headers
