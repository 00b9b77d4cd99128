"""Web server of the page of a live session. By default, only this machine can connect; an address that other machines
can reach requires a token."""

from __future__ import annotations

import contextlib
import secrets
import socket
import threading
from collections.abc import Callable
from ipaddress import ip_address
from urllib.parse import quote

from jeit.arguments.extras import require_extra
from jeit.live.page.hub import PageHub
from jeit.live.session import Session


def serve(
    session: Session,
    *,
    host: str = "127.0.0.1",
    port: int = 0,
    token: str | None = None,
    opened: Callable[[str], None] | None = None,
    stay: bool = False,
) -> None:
    """Serve the page of a started session until the session ends, or until Ctrl-C.

    **Arguments:**

    - `session`: the session.
    - `host`, `port`: address at which to listen; port 0 selects a free port.
    - `token`: token that the page's address must contain; by default a random token for a host that other machines can
      reach, otherwise none.
    - `opened`: function that is called with the page's address once the page can be opened.
    - `stay`: whether to continue until Ctrl-C when the session has ended, so that its last minute can be viewed.

    Raises `OSError` if the address is in use or does not belong to this machine, and `ImportError` if the packages of
    the extra `live` are not installed.

    **Example:**

    ```python
    with Session(simulated_tank(100.0, limit=20), view) as session:
        serve(session, opened=print)  # with uvicorn
    ```
    """
    require_extra("live", "a page in the browser")
    import uvicorn

    from jeit.live.page.application import is_loopback, make_application
    from jeit.live.page.wire import MAX_COMMAND_LENGTH

    if token is None and not is_loopback(host):
        token = secrets.token_urlsafe(24)
    page_hub = PageHub(session)
    server_socket = _open_socket(host, port)
    with server_socket:
        server_config = uvicorn.Config(
            make_application(page_hub, host=host, token=token),
            log_level="error",
            access_log=False,  # it would contain the token
            ws="websockets-sansio",
            ws_max_size=MAX_COMMAND_LENGTH,
            ws_max_queue=64,
            ws_per_message_deflate=False,  # costs more time than it saves bytes
            server_header=False,
            proxy_headers=False,
            limit_concurrency=200,
            timeout_graceful_shutdown=2,
        )
        server = uvicorn.Server(server_config)
        if not stay:
            threading.Thread(target=_stop_at_session_end, args=(page_hub, server), daemon=True).start()
        if opened is not None:
            opened(_page_address(host, server_socket.getsockname()[1], token))
        with contextlib.suppress(KeyboardInterrupt):
            server.run(sockets=[server_socket])


def check_port(host: str, port: int) -> None:
    """Raise `OSError`, with advice to the user, if a page cannot be served at `host` and `port`."""
    _open_socket(host, port).close()


def _stop_at_session_end(page_hub: PageHub, server: object) -> None:
    page_hub.ended.wait()
    server.should_exit = True  # pyright: ignore[reportAttributeAccessIssue]


def _open_socket(host: str, port: int) -> socket.socket:
    """Return a socket that listens at a host and port. Raises `OSError`, with advice to the user, if it cannot be
    opened."""
    if not 0 <= port <= 65535:
        raise OSError(f"port: {port} is none; they go from 1 to 65535, and 0 takes a free one")
    try:
        socket_family, socket_type, protocol_number, _, socket_address = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM
        )[0]
    except (socket.gaierror, UnicodeError) as error:
        raise OSError(f"cannot listen on {host!r}, port {port}: {error}") from error
    server_socket = socket.socket(socket_family, socket_type, protocol_number)
    try:
        server_socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        server_socket.bind(socket_address)
        server_socket.listen(128)
    except OSError as error:
        server_socket.close()
        remedy_text = f"port {port} is taken or not allowed: choose another, or 0 for any free one"
        raise OSError(error.errno, f"cannot listen on {host}, port {port} ({error.strerror}); {remedy_text}") from error
    return server_socket


def _page_address(host: str, port: int, token: str | None) -> str:
    """URL of the page. For the unspecified host 0.0.0.0, the URL contains the address under which other machines reach
    this machine."""
    host_in_address = host
    try:
        if ip_address(host).is_unspecified:
            host_in_address = _own_ip_address()
        if ip_address(host_in_address).version == 6:
            host_in_address = f"[{host_in_address}]"
    except ValueError:
        pass
    query_string = f"?token={quote(token, safe='')}" if token else ""
    return f"http://{host_in_address}:{port}/{query_string}"


def _own_ip_address() -> str:
    """IP address of this machine in its network. The function sends no data."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe_socket:
        try:
            probe_socket.connect(("192.0.2.1", 9))
            return str(probe_socket.getsockname()[0])
        except OSError:
            return "127.0.0.1"
