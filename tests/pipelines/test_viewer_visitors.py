"""Who leads where several pages of the viewer report their views."""

from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
import viser

from devrf.pipelines.viewer import visitors as viewer_visitors
from devrf.pipelines.viewer.visitors import LEAD_S, Visitors


def a_page(number: int) -> Any:
    """A page, with what viser keeps of one."""
    page = MagicMock(spec=viser.ClientHandle, client_id=number)
    page.camera = MagicMock(spec=viser.CameraHandle)
    page.camera.configure_mock(
        fov=1.0, position=np.zeros(3), look_at=np.ones(3), up_direction=np.eye(3)[2], wxyz=np.eye(4)[0]
    )
    return page


def a_server(*pages: Any) -> Any:
    """A server whose event loop does at once what it is given."""
    server = MagicMock(spec=viser.ViserServer)
    server.get_clients.return_value = {page.client_id: page for page in pages}
    server.get_event_loop().call_soon_threadsafe = lambda work: work()
    return server


def test_what_a_page_reports_while_another_one_leads_does_not_part_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now = 100.0
    monkeypatch.setattr(viewer_visitors, "time", SimpleNamespace(monotonic=lambda: now))
    first, second = a_page(0), a_page(1)
    visitors = Visitors(a_server(first, second))

    first.camera.position = np.array([1.0, 2, 3])
    assert visitors.lead(first)
    np.testing.assert_array_equal(second.camera.position, [1, 2, 3])

    now += 0.5 * LEAD_S
    second.camera.position = np.array([9.0, 9, 9])  # what it was before it heard of the first one
    assert not visitors.lead(second)
    np.testing.assert_array_equal(second.camera.position, [1, 2, 3])
    np.testing.assert_array_equal(first.camera.position, [1, 2, 3])

    told = second.camera.position
    assert not visitors.lead(second)  # an echo, which is not answered: no two pages talk for ever
    assert second.camera.position is told

    now += LEAD_S
    second.camera.position = np.array([4.0, 5, 6])
    assert visitors.lead(second)
    np.testing.assert_array_equal(first.camera.position, [4, 5, 6])
