"""The web application of a live session: the files of the page, a WebSocket for pictures, state and commands, and the
access control, which checks the host, the origin and a token of each request."""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import secrets
import socket
from collections.abc import AsyncIterator
from importlib import resources
from urllib.parse import parse_qs, urlsplit

from starlette.applications import Starlette
from starlette.datastructures import Headers, MutableHeaders
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocket, WebSocketDisconnect

from jeit.live.page.hub import PageHub, Viewer
from jeit.live.page.wire import (
    Command,
    Drawn,
    Follow,
    Mark,
    Record,
    Reference,
    Seen,
    Show,
    read_command,
    to_json,
)

_TOKEN_PATHS = ("/", "/socket")
"""Paths that require the token. The other files need no protection, since they are the same in every installation."""

_SECURITY_HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}
MAX_VIEWERS = 16
_MAX_INVALID_MESSAGES = 20
_MEDIA_TYPES = {"html": "text/html", "js": "text/javascript", "css": "text/css", "svg": "image/svg+xml"}


def is_loopback(host: str) -> bool:
    """Whether a host name or address is a loopback address, which other machines cannot reach."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _is_address(host_name: str) -> bool:
    try:
        ipaddress.ip_address(host_name)
    except ValueError:
        return False
    return True


def _is_unspecified(host_name: str) -> bool:
    return _is_address(host_name) and ipaddress.ip_address(host_name).is_unspecified


def _host_name(host_header: str) -> str:
    """Return the host in a request's header `host[:port]`, in lower case; "" if the header is invalid."""
    try:
        return (urlsplit(f"//{host_header}").hostname or "").rstrip(".")
    except ValueError:
        return ""


def is_host_allowed(header: str, server_host: str) -> bool:
    """Whether the host that a request names in its `header` is a name or address of the server at `server_host`.

    The domain name of another site can resolve to this machine, and the scripts of that site then reach this server
    under this domain name (DNS rebinding). Such a domain name is neither an address nor the name of this machine, so
    the request is refused. Any port is allowed, so that a tunnel works.
    """
    name = _host_name(header)
    if is_loopback(name) or name == server_host.lower():
        return True
    if not _is_unspecified(server_host):
        return False
    host_name = socket.gethostname().lower()
    return _is_address(name) or name in (host_name, f"{host_name.split('.')[0]}.local")


class RequestGuard:
    """Middleware that refuses requests for another host, WebSockets from another origin, and requests without the
    token.

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
        requested_host = Headers(scope=scope).get("host", "")
        refusal_reason = self._find_problem(scope, requested_host)
        if refusal_reason is None:
            await self._app(scope, receive, self._with_security_headers(send, requested_host))
        elif scope["type"] == "websocket":
            await receive()
            await send({"type": "websocket.close", "code": 1008, "reason": refusal_reason})
        else:
            await PlainTextResponse(refusal_reason + "\n", 403, headers=_SECURITY_HEADERS)(scope, receive, send)

    def _find_problem(self, scope: Scope, requested_host: str) -> str | None:
        if not is_host_allowed(requested_host, self._host):
            return "This host name is not one of this server: open the address that `jeit live` prints."
        page_origin = Headers(scope=scope).get("origin")
        if (page_origin is not None or scope["type"] == "websocket") and page_origin not in (
            f"http://{requested_host}",
            f"https://{requested_host}",
        ):
            return "Another site's page may not use this server."
        if self._token is not None and scope["path"] in _TOKEN_PATHS:
            request_token = parse_qs(scope["query_string"].decode("latin-1")).get("token", [""])[0]
            if not secrets.compare_digest(request_token.encode(), self._token.encode()):
                return "The token is missing or wrong: open the address that `jeit live` prints, with its ?token=…"
        return None

    @staticmethod
    def _with_security_headers(send: Send, requested_host: str) -> Send:
        """Add headers to a response that make the browser run only the page's own files, and not show the page in a
        frame of another site."""
        content_security_policy = (
            "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; media-src blob:; "
            f"connect-src 'self' ws://{requested_host} wss://{requested_host}; base-uri 'none'; form-action 'none'; "
            "frame-ancestors 'none'"
        )

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                response_headers = MutableHeaders(scope=message)
                response_headers.update({**_SECURITY_HEADERS, "Content-Security-Policy": content_security_policy})
            await send(message)

        return send_with_headers


def page_files() -> dict[str, bytes]:
    """Return the contents of the page's files by name. The files are read once, so that no request accesses the
    disk."""
    folder = resources.files("jeit.live.page").joinpath("static")
    return {file.name: file.read_bytes() for file in folder.iterdir() if file.name.rpartition(".")[2] in _MEDIA_TYPES}


def make_application(hub: PageHub, *, host: str, token: str | None) -> Starlette:
    """Return the web application that shows a session's pictures; `host`, `token`: as in `RequestGuard`."""
    allowed_files = page_files()

    def file(request: Request) -> Response:
        name = request.path_params.get("name", "index.html")
        if name not in allowed_files:
            return Response("There is no such page.\n", 404, media_type="text/plain")
        return Response(allowed_files[name], media_type=_MEDIA_TYPES[name.rpartition(".")[2]])

    async def serve_socket(websocket: WebSocket) -> None:
        await _serve_viewer(hub, websocket)

    @contextlib.asynccontextmanager
    async def application_lifespan(_app: Starlette) -> AsyncIterator[None]:
        hub.start()
        try:
            yield
        finally:
            await asyncio.to_thread(hub.close)

    return Starlette(
        routes=[Route("/", file), WebSocketRoute("/socket", serve_socket), Route("/{name}", file)],
        middleware=[Middleware(RequestGuard, host=host, token=token)],
        lifespan=application_lifespan,
    )


async def _serve_viewer(hub: PageHub, websocket: WebSocket) -> None:
    """Send pictures and states to one open page, and execute its commands, until the page disconnects."""
    await websocket.accept()
    if len(hub.viewers) >= MAX_VIEWERS:
        await websocket.close(1013, f"{MAX_VIEWERS} pages are open already")
        return
    page_viewer = Viewer()
    hub.viewers.add(page_viewer)
    page_viewer.wake_event.set()
    send_task = asyncio.create_task(_send_pictures(hub, page_viewer, websocket))
    try:
        await _receive_commands(hub, page_viewer, websocket)
    finally:
        hub.viewers.discard(page_viewer)
        send_task.cancel()
        with contextlib.suppress(asyncio.CancelledError, WebSocketDisconnect, RuntimeError):
            await send_task


async def _send_pictures(hub: PageHub, page_viewer: Viewer, websocket: WebSocket) -> None:
    await websocket.send_text(hub.scene)
    while True:
        await page_viewer.wake_event.wait()
        page_viewer.wake_event.clear()
        if page_viewer.is_state_due():
            await websocket.send_text(hub.state_message(page_viewer))
        newest_picture = hub.newest_picture()
        if newest_picture is not None and page_viewer.is_ready_for(newest_picture[0].frame.number):
            page_viewer.record_sent(newest_picture[0].frame.number, newest_picture[0].frame.arrived)
            await websocket.send_bytes(newest_picture[1])


async def _receive_commands(hub: PageHub, page_viewer: Viewer, websocket: WebSocket) -> None:
    num_invalid_messages = 0
    while True:
        message = await websocket.receive()
        if message["type"] == "websocket.disconnect":
            return
        try:
            page_command = read_command(message.get("text") or message.get("bytes") or "")
        except ValueError as error:
            num_invalid_messages += 1
            if num_invalid_messages > _MAX_INVALID_MESSAGES:
                await websocket.close(1008, "too many messages that are no commands")
                return
            await websocket.send_text(to_json("answer", {"to": "message", "problem": str(error)}))
            continue
        await _execute_command(page_command, hub, page_viewer, websocket)


async def _execute_command(page_command: Command, hub: PageHub, page_viewer: Viewer, websocket: WebSocket) -> None:
    match page_command:
        case Drawn(number=frame_number, hidden=is_page_hidden):
            page_viewer.record_drawn(frame_number, hidden=is_page_hidden)
            return
        case Seen():
            page_viewer.read_state()
            return
        case Follow(on=on):
            page_viewer.following = on
            page_viewer.wake_event.set()
            return
        case Show(number=frame_number, direction=search_direction):
            past_picture_message = hub.past_picture_message(frame_number, search_direction)
            if past_picture_message is not None:
                await websocket.send_bytes(past_picture_message)
                return
            reply_message = ("show", "that picture is no longer kept: the last minute is")
        case _:
            reply_message = await _execute_session_command(page_command, hub)
    await websocket.send_text(to_json("answer", {"to": reply_message[0], "problem": reply_message[1]}))


async def _execute_session_command(page_command: Command, hub: PageHub) -> tuple[str, str | None]:
    """Execute a command of the page that changes the session, in another thread, because the command may write to disk.
    Returns the name of the command, and the error message or None."""
    live_session = hub.session
    try:
        match page_command:
            case Reference(count=num_reference_frames):
                await asyncio.to_thread(live_session.take_reference, num_reference_frames)
            case Mark(label=event_label):
                await asyncio.to_thread(live_session.mark, event_label)
            case Record(on=on):
                await asyncio.to_thread(live_session.record, on)
    except (ValueError, OSError, RuntimeError) as error:
        return type(page_command).__name__.lower(), str(error)
    return type(page_command).__name__.lower(), None
