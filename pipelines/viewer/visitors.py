"""Whose page leads: all visitors see what is seen on the page that was moved last."""

import time
from collections.abc import Callable, Iterable

import viser

from devrf.pipelines.viewer.views import apart, follow

LEAD_S = 1.0  # for which a page that was moved has the view: the others say where they are with some delay


class Visitors:
    """The pages of a server.

    Attributes:
        leader: The visitor whose page was moved last; None where there is none.
    """

    def __init__(self, server: viser.ViserServer) -> None:
        self.server = server
        self.leader: viser.ClientHandle | None = None
        self._led = 0.0  # when the leader's page was moved

    def turn(self, pages: Iterable[viser.ClientHandle], turn: Callable[[viser.CameraHandle], None]) -> None:
        """Turn pages in the server's event loop, where their messages are read.

        What is set of a page depends on what was set before: nothing that it says of itself may come between.
        """

        def turned() -> None:
            for page in pages:
                with page.atomic():
                    turn(page.camera)

        self.server.get_event_loop().call_soon_threadsafe(turned)

    def lead(self, client: viser.ClientHandle) -> bool:
        """Let the others follow a page that says that it was moved; False: another one leads, and it is led back."""
        now, leader = time.monotonic(), self.leading()
        if leader is not None and leader is not client and now - self._led < LEAD_S:
            # Else it would stay where it was before it heard of the leader.
            if apart(client.camera, leader.camera):
                self.turn([client], lambda page: follow(page, leader.camera))
            return False
        self.leader, self._led = client, now
        others = [page for page in self.server.get_clients().values() if page is not client]
        self.turn(others, lambda page: follow(page, client.camera))
        return True

    def leading(self) -> viser.ClientHandle | None:
        """Who has the view: if that visitor has left, another."""
        clients = self.server.get_clients()
        if self.leader is None or self.leader.client_id not in clients:
            self.leader = next(iter(clients.values()), None)
        return self.leader
