"""The web application of a live session: the files of the page, and a WebSocket for pictures, state and commands."""

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

MAX_VIEWERS = 16
_MAX_FAULTS = 20
_MEDIA_TYPES = {"html": "text/html", "js": "text/javascript", "css": "text/css", "svg": "image/svg+xml"}


def page_files() -> dict[str, bytes]:
    """Return the contents of the page's files by name. The files are read once, so that no request accesses the
    disk."""
    folder = resources.files("jeit.live.page").joinpath("static")
    return {file.name: file.read_bytes() for file in folder.iterdir() if file.name.rpartition(".")[2] in _MEDIA_TYPES}


def make_application(hub: Hub, *, host: str, token: str | None) -> Starlette:
    """Return the web application that shows a session's pictures; `host`, `token`: as in `Guard`."""
    files = page_files()

    def file(request: Request) -> Response:
        name = request.path_params.get("name", "index.html")
        if name not in files:
            return Response("There is no such page.\n", 404, media_type="text/plain")
        return Response(files[name], media_type=_MEDIA_TYPES[name.rpartition(".")[2]])

    async def socket(websocket: WebSocket) -> None:
        await _serve_viewer(hub, websocket)

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


async def _serve_viewer(hub: Hub, websocket: WebSocket) -> None:
    """Send pictures and states to one open page, and execute its commands, until the page disconnects."""
    await websocket.accept()
    if len(hub.viewers) >= MAX_VIEWERS:
        await websocket.close(1013, f"{MAX_VIEWERS} pages are open already")
        return
    viewer = Viewer()
    hub.viewers.add(viewer)
    viewer.wake_event.set()
    send_task = asyncio.create_task(_send_pictures(hub, viewer, websocket))
    try:
        await _receive_commands(hub, viewer, websocket)
    finally:
        hub.viewers.discard(viewer)
        send_task.cancel()
        with contextlib.suppress(asyncio.CancelledError, WebSocketDisconnect, RuntimeError):
            await send_task


async def _send_pictures(hub: Hub, viewer: Viewer, websocket: WebSocket) -> None:
    await websocket.send_text(hub.scene)
    while True:
        await viewer.wake_event.wait()
        viewer.wake_event.clear()
        if viewer.wants_state():
            await websocket.send_text(hub.state_message(viewer))
        newest = hub.newest()
        if newest is not None and viewer.ready_for(newest[0].frame.number):
            viewer.note_sent(newest[0].frame.number, newest[0].frame.arrived)
            await websocket.send_bytes(newest[1])


async def _receive_commands(hub: Hub, viewer: Viewer, websocket: WebSocket) -> None:
    faults = 0
    while True:
        message = await websocket.receive()
        if message["type"] == "websocket.disconnect":
            return
        try:
            command = read_command(message.get("text") or message.get("bytes") or "")
        except ValueError as error:
            faults += 1
            if faults > _MAX_FAULTS:
                await websocket.close(1008, "too many messages that are no commands")
                return
            await websocket.send_text(to_json("answer", {"to": "message", "problem": str(error)}))
            continue
        await _execute_command(command, hub, viewer, websocket)


async def _execute_command(command: Command, hub: Hub, viewer: Viewer, websocket: WebSocket) -> None:
    match command:
        case Drawn(number=number, hidden=hidden):
            viewer.note_drawn(number, hidden=hidden)
            return
        case Seen():
            viewer.read_state()
            return
        case Follow(on=on):
            viewer.following = on
            viewer.wake_event.set()
            return
        case Show(number=number, direction=direction):
            past_message = hub.past_message(number, direction)
            if past_message is not None:
                await websocket.send_bytes(past_message)
                return
            answer = ("show", "that picture is no longer kept: the last minute is")
        case _:
            answer = await _execute_session_command(command, hub)
    await websocket.send_text(to_json("answer", {"to": answer[0], "problem": answer[1]}))


async def _execute_session_command(command: Command, hub: Hub) -> tuple[str, str | None]:
    """Execute a command of the page that changes the session, in another thread, because the command may write to disk.
    Returns the name of the command, and the error message or None."""
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
