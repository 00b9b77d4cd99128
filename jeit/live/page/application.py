"""The web application of a live session: its files, and a WebSocket for pictures, state and commands."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from importlib import resources

from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect

from jeit.live.page.guard import Guard
from jeit.live.page.hub import Hub, Viewer
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

MOST_VIEWERS = 16
_MOST_FAULTS = 20
_TYPES = {"html": "text/html", "js": "text/javascript", "css": "text/css", "svg": "image/svg+xml"}


def page_files() -> dict[str, bytes]:
    """Return the page's files by name; they are read once, so that no request names a path on disk."""
    folder = resources.files("jeit.live.page").joinpath("static")
    return {file.name: file.read_bytes() for file in folder.iterdir() if file.name.rpartition(".")[2] in _TYPES}


def make_application(hub: Hub, *, host: str, token: str | None) -> Starlette:
    """Return the application that shows a session's pictures; `host`, `token`: as in `Guard`."""
    files = page_files()

    def file(request: Request) -> Response:
        name = request.path_params.get("name", "index.html")
        if name not in files:
            return Response("There is no such page.\n", 404, media_type="text/plain")
        return Response(files[name], media_type=_TYPES[name.rpartition(".")[2]])

    async def socket(websocket: WebSocket) -> None:
        await _attend(hub, websocket)

    @contextlib.asynccontextmanager
    async def lifespan(_app: Starlette) -> AsyncIterator[None]:
        hub.start()
        try:
            yield
        finally:
            await asyncio.to_thread(hub.close)

    return Starlette(
        routes=[Route("/", file), WebSocketRoute("/socket", socket), Route("/{name}", file)],
        middleware=[Middleware(Guard, host=host, token=token)],
        lifespan=lifespan,
    )


async def _attend(hub: Hub, websocket: WebSocket) -> None:
    """Serve one page until it leaves."""
    await websocket.accept()
    if len(hub.viewers) >= MOST_VIEWERS:
        await websocket.close(1013, f"{MOST_VIEWERS} pages are open already")
        return
    viewer = Viewer()
    hub.viewers.add(viewer)
    viewer.news.set()
    sending = asyncio.create_task(_send(hub, viewer, websocket))
    try:
        await _receive(hub, viewer, websocket)
    finally:
        hub.viewers.discard(viewer)
        sending.cancel()
        with contextlib.suppress(asyncio.CancelledError, WebSocketDisconnect, RuntimeError):
            await sending


async def _send(hub: Hub, viewer: Viewer, websocket: WebSocket) -> None:
    await websocket.send_text(hub.scene)
    while True:
        await viewer.news.wait()
        viewer.news.clear()
        if viewer.wants_state():
            await websocket.send_text(hub.state_message(viewer))
        newest = hub.newest()
        if newest is not None and viewer.ready_for(newest[0].frame.number):
            viewer.sent(newest[0].frame.number, newest[0].frame.arrived)
            await websocket.send_bytes(newest[1])


async def _receive(hub: Hub, viewer: Viewer, websocket: WebSocket) -> None:
    faults = 0
    while True:
        message = await websocket.receive()
        if message["type"] == "websocket.disconnect":
            return
        try:
            command = read_command(message.get("text") or message.get("bytes") or "")
        except ValueError as error:
            faults += 1
            if faults > _MOST_FAULTS:
                await websocket.close(1008, "too many messages that are no commands")
                return
            await websocket.send_text(to_json("answer", {"to": "message", "problem": str(error)}))
            continue
        await _carry_out(command, hub, viewer, websocket)


async def _carry_out(command: Command, hub: Hub, viewer: Viewer, websocket: WebSocket) -> None:
    match command:
        case Drawn(number=number, hidden=hidden):
            viewer.drew(number, hidden=hidden)
            return
        case Seen():
            viewer.read_state()
            return
        case Follow(on=on):
            viewer.following = on
            viewer.news.set()
            return
        case Show(number=number, direction=direction):
            past = hub.past(number, direction)
            if past is not None:
                await websocket.send_bytes(past)
                return
            answer = ("show", "that picture is no longer kept: the last minute is")
        case _:
            answer = await _act(command, hub)
    await websocket.send_text(to_json("answer", {"to": answer[0], "problem": answer[1]}))


async def _act(command: Command, hub: Hub) -> tuple[str, str | None]:
    """Carry out a command that changes the session, away from the event loop, as it may write to disk."""
    session = hub.session
    try:
        match command:
            case Reference(count=count):
                await asyncio.to_thread(session.take_reference, count)
            case Mark(label=label):
                await asyncio.to_thread(session.mark, label)
            case Record(on=on):
                await asyncio.to_thread(session.record, on)
    except (ValueError, OSError, RuntimeError) as error:
        return type(command).__name__.lower(), str(error)
    return type(command).__name__.lower(), None
