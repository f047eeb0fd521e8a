"""Who is served: browsers that were sent to the viewer by its own address, not pages from elsewhere.

A page of any site that is open in a browser of this machine can ask for `ws://localhost` (its Origin tells), and a name
of its own can be made to lead here (DNS rebinding; the Host tells). viser asks for neither.
"""

import socket
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from ipaddress import ip_address
from typing import Any
from urllib.parse import urlsplit

FORBIDDEN = 403  # of HTTP


def refusal(host: str | None, origin: str | None, names: Collection[str]) -> str | None:
    """Why a request is not served; None where it is.

    Args:
        host, origin: Its headers.
        names: Under which the viewer may be reached, besides addresses in numbers and this machine's own name.
    """
    own = {"localhost", socket.gethostname().lower(), *(name.lower() for name in names)}
    name = _name(f"//{host}")
    if name is None or not (name in own or _is_number(name)):
        return (
            f"Host {host}: is not this viewer's; if it should be, start it with --allow-host {name or 'NAME'}"
        )
    if origin is None or urlsplit(origin).netloc == host:
        return None
    asking = _name(origin)
    if asking in {name.lower() for name in names}:
        return None
    return f"Origin {origin}: is not this viewer's page; if it should be, start it with --allow-host {asking or 'NAME'}"


@contextmanager
def only_own_pages(names: Collection[str]) -> Iterator[None]:
    """Servers of viser's that are begun meanwhile refuse all others."""
    from websockets.asyncio import server

    serve = server.serve

    def guarded(*arguments: Any, process_request: Callable[..., Any], **options: Any) -> Any:
        def asked(connection: Any, request: Any) -> Any:
            why = refusal(request.headers.get("Host"), request.headers.get("Origin"), names)
            if why is None:
                return process_request(connection, request)
            return connection.respond(FORBIDDEN, f"{why}\n")

        return serve(*arguments, process_request=asked, **options)

    server.serve = guarded
    try:
        yield
    finally:
        server.serve = serve


def _name(url: str) -> str | None:
    try:
        return urlsplit(url).hostname
    except ValueError:
        return None


def _is_number(name: str) -> bool:
    try:
        ip_address(name)
    except ValueError:
        return False
    return True
