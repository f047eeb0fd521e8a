"""Where pages are served, and to whom: browsers that were sent by the viewer's own address, not pages from elsewhere.

A page of any site that is open in a browser of this machine can ask for `ws://localhost` (its Origin tells), and a name
of its own can be made to lead here (DNS rebinding; the Host tells). viser asks for neither.
"""

import socket
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from ipaddress import IPv4Address, IPv6Address, ip_address
from typing import Any
from urllib.parse import urlsplit

FORBIDDEN = 403  # of HTTP


@dataclass(frozen=True)
class Address:
    """Where pages are served.

    Attributes:
        host, port: What the server listens on.
        names: By which browsers may ask for them, besides this machine's own.
    """

    host: str
    port: int
    names: Collection[str] = ()

    def __str__(self) -> str:
        """What a browser on this machine is given."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"http://{'localhost' if self.host in ('0.0.0.0', '::') else host}:{self.port}"


def refusal(host: str | None, origin: str | None, names: Collection[str]) -> str | None:
    """Why a request is not served; None where it is.

    Args:
        host, origin: Its headers.
        names: Under which the viewer may be reached, besides addresses in numbers and this machine's own name.
    """
    named, name = {name.lower() for name in names}, _name(f"//{host}")
    own = {"localhost", socket.gethostname().lower(), *named}
    remedy = "if it should be, start it with --allow-host"
    if name is None or not (name in own or _number(name) is not None):
        return f"Host {host}: is not this viewer's; {remedy} {name or 'NAME'}"
    if origin is None:
        return None
    page = _name(origin)
    if page is not None and (urlsplit(origin).netloc == host or page in named):
        return None
    return f"Origin {origin}: is not this viewer's page; {remedy} {page or 'NAME'}"


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


def is_loopback(host: str) -> bool:
    """Whether only this machine reaches what is served there."""
    number = _number(host)
    return host == "localhost" if number is None else number.is_loopback


def _name(url: str) -> str | None:
    try:
        return urlsplit(url).hostname
    except ValueError:
        return None


def _number(name: str) -> IPv4Address | IPv6Address | None:
    try:
        return ip_address(name)
    except ValueError:
        return None
