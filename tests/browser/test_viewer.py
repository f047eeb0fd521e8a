# ruff: noqa: F811 (fixtures are arguments)
"""The viewer in a real browser: opened before there is anything, in training, finished; slid, turned, played."""

import io
import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from PIL import Image
from tests.pipelines.viewer_run import ViewerRun
from tests.reconstruct.conftest import Ball, ball, rest  # noqa: F401 (fixtures)
from tests.waiting import wait_for

from devrf.capture.photos.resize import shrink
from devrf.pipelines.config.load import load_scene
from devrf.pipelines.viewer import server as viewer_site
from devrf.pipelines.viewer.own_address import Address
from devrf.pipelines.viewer.server import Site
from devrf.pipelines.viewer.views import first_camera, seen_by
from devrf.pipelines.viewer.visitors import LEAD_S
from devrf.reconstruct.fields.canonical_model import RestModel
from devrf.reconstruct.rendering.model import DynamicModel, render_view
from devrf.reconstruct.storage.model_io import load_model

pytestmark = pytest.mark.full

WINDOW = {"width": 640, "height": 300}
COMPARED = 80, 80  # pixels of the middle of pictures that are compared
LIMIT_S = 60.0
SAME_DB = 27.0  # JPEG, and lines one pixel wide apart


@dataclass
class Visited:
    """A page, the site that serves it, and what was seen on the way there."""

    page: Any
    site: Site
    model: DynamicModel
    texts: list[str]
    rendered: dict[tuple, np.ndarray] = field(default_factory=dict)

    def eye(self) -> Any:
        """Where the visitor looks from."""
        assert self.site.visitors.leader is not None
        return self.site.visitors.leader.camera

    def picture(self) -> np.ndarray:
        """The page's picture of the scene, without what lies above it at the sides, as floats in [0, 1]."""
        box = self.page.locator("canvas").first.bounding_box()
        picture = Image.open(io.BytesIO(self.page.screenshot(clip=box))).convert("RGB")
        return _middle(np.asarray(picture))

    def expected(self, moment: float | None) -> np.ndarray:
        """The same of a picture rendered without the viewer."""
        eye, clients = self.eye(), self.site.server.get_clients()
        key = eye.position.tobytes(), eye.wxyz.tobytes(), moment
        if key not in self.rendered:
            own = clients[min(clients)].camera
            picture = render_view(self.model, seen_by(eye, own.image_width, own.image_height), moment)
            self.rendered[key] = _middle(np.round(picture * 255))
        return self.rendered[key]

    def shows(self, moment: float | None) -> Callable[[], bool]:
        """Whether the page's picture is the one that is rendered for a moment."""
        return lambda: _psnr(self.picture(), self.expected(moment)) > SAME_DB


def _middle(picture: np.ndarray) -> np.ndarray:
    height, width = picture.shape[:2]
    part = picture[height // 4 : -height // 4, width // 4 : -width // 4]
    return shrink(np.ascontiguousarray(part, dtype=np.float32), *COMPARED) / 255


def _psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(-10 * np.log10(np.mean((a - b) ** 2) + 1e-12))


@pytest.fixture(scope="module")
def visited(
    browser: Any, ball: Ball, rest: RestModel, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Visited]:
    """A page that is opened on an empty folder and stays open while the run goes on to its end."""
    run = ViewerRun(tmp_path_factory.mktemp("viewer"))
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    at = Address("127.0.0.1", port)
    site = Site(load_scene(run.scene_yaml, check_files=False), run.run_dir, "cpu", at)
    page = browser.new_page(viewport=WINDOW)
    complaints: list[str] = []
    page.on("pageerror", lambda error: complaints.append(str(error)))
    texts: list[str] = []

    def reads(words: str) -> None:
        page.get_by_text(words).first.wait_for(timeout=1000 * LIMIT_S)
        texts.append(page.locator("body").inner_text())

    page.goto(f"http://127.0.0.1:{port}")
    reads("nothing to show yet")
    page.locator("button.mantine-CloseButton-root").first.click()  # a warning that WebGL is slow here
    run.scene(ball.scene)
    reads("no model yet")
    run.rest_in_training(rest)
    reads("scene at rest")
    run.rest(rest)
    run.motion(rest)
    reads("finished model")
    out = Visited(page, site, load_model(run.run_dir), texts)
    page.get_by_role("checkbox", name="cameras", exact=True).click()
    yield out
    page.close()
    site.close()
    assert not complaints, complaints


def test_it_opens_before_there_is_anything_and_follows_the_run(visited: Visited, ball: Ball) -> None:
    empty, scene, training, finished = visited.texts
    assert "ball <b>" in empty and "not finished" in empty
    assert "cameras and points" in scene
    assert "interrupted" in training  # nobody works in this folder
    assert "not finished" in finished and "evaluate" in finished
    wait_for(visited.shows(0.0), LIMIT_S)
    assert visited.picture().std() > 0.05
    np.testing.assert_allclose(visited.eye().position, first_camera(ball.scene).centre, atol=1e-3)


def test_a_slide_in_time_shows_another_moment(visited: Visited) -> None:
    page = visited.page
    wait_for(visited.shows(0.0), LIMIT_S)
    assert _psnr(visited.expected(0.0), visited.expected(1.0)) < SAME_DB - 5
    page.get_by_role("slider").first.press("End")
    wait_for(visited.shows(1.0), LIMIT_S)
    page.get_by_role("checkbox", name="at rest").click()
    wait_for(visited.shows(None), LIMIT_S)
    page.get_by_role("checkbox", name="at rest").click()
    page.get_by_role("slider").first.press("Home")
    wait_for(visited.shows(0.0), LIMIT_S)


def drag(page: Any) -> None:
    """Turn a page's view."""
    page.mouse.move(120, 150)
    page.mouse.down()
    page.mouse.move(220, 130, steps=6)
    page.mouse.up()


def test_a_turned_view_is_rendered_anew(visited: Visited) -> None:
    page, before = visited.page, visited.eye().position
    old = visited.expected(0.0)
    drag(page)
    wait_for(lambda: np.linalg.norm(visited.eye().position - before) > 0.5, LIMIT_S)
    wait_for(lambda: visited.shows(0.0)() and _psnr(visited.picture(), old) < SAME_DB - 5, LIMIT_S)
    page.get_by_text("Back to the first view").click()
    wait_for(lambda: np.linalg.norm(visited.eye().position - before) < 0.05, LIMIT_S)
    wait_for(visited.shows(0.0), LIMIT_S)


def test_it_plays_and_pauses(visited: Visited) -> None:
    page, slider = visited.page, visited.page.get_by_role("slider").first
    page.get_by_role("button", name="Play").click()
    moments = set()
    wait_for(lambda: moments.add(slider.get_attribute("aria-valuenow")) or len(moments) > 3, LIMIT_S)
    page.get_by_role("button", name="Pause").click()
    page.get_by_role("button", name="Play").wait_for()

    def at() -> float:
        return float(slider.get_attribute("aria-valuenow"))

    wait_for(lambda: visited.shows(at())(), LIMIT_S)  # the slider catches up with the picture once more
    stands = at()
    time.sleep(0.5)
    assert at() == stands


def test_a_click_on_a_camera_looks_through_it(visited: Visited, ball: Ball) -> None:
    frame = next(f for f in ball.scene.dynamic if f.split == "train")
    visited.site.look_through(frame.camera)
    wait_for(lambda: np.linalg.norm(visited.eye().position - frame.camera.centre) < 1e-3, LIMIT_S)

    def turned() -> float:
        axes = seen_by(visited.eye(), 8, 8).cam_from_world[:, :3]
        return float(np.abs(axes - frame.camera.cam_from_world[:, :3]).max())

    wait_for(lambda: turned() < 0.02, LIMIT_S)


def test_nothing_that_the_page_says_comes_between_the_parts_of_a_view(
    visited: Visited, ball: Ball, monkeypatch: pytest.MonkeyPatch
) -> None:
    threads = []

    look_through = viewer_site.look_through

    def watched(*args: Any) -> None:
        threads.append(threading.get_ident())
        look_through(*args)

    monkeypatch.setattr(viewer_site, "look_through", watched)
    reads_messages: list[int] = []
    visited.site.server.get_event_loop().call_soon_threadsafe(
        lambda: reads_messages.append(threading.get_ident())
    )
    for frame in ball.scene.dynamic[:3]:
        visited.site.look_through(frame.camera)
    wait_for(lambda: len(threads) == 3, LIMIT_S)
    assert threads == 3 * reads_messages


def test_all_visitors_share_one_view_one_time_and_one_picture(visited: Visited, browser: Any) -> None:
    """A page that comes later, and is narrower, is moved: the first one follows."""
    page, site = visited.page, visited.site
    other = browser.new_page(viewport={**WINDOW, "width": 600})
    other.goto(page.url)
    other.locator("button.mantine-CloseButton-root").first.click()  # a warning that WebGL is slow here
    wait_for(lambda: len(site.server.get_clients()) == 2, LIMIT_S)
    first, second = (client.camera for client in site.server.get_clients().values())

    def together() -> bool:
        return bool(np.abs(first.position - second.position).max() < 1e-3)

    wait_for(together, LIMIT_S)
    before = first.position
    time.sleep(LEAD_S)
    drag(other)
    wait_for(lambda: np.linalg.norm(second.position - before) > 0.3 and together(), LIMIT_S)
    page.get_by_role("slider").first.press("End")
    other.get_by_role("slider").first.and_(other.locator("[aria-valuenow='1']")).wait_for()
    wait_for(visited.shows(1.0), LIMIT_S)
    other.close()
    wait_for(lambda: len(site.server.get_clients()) == 1, LIMIT_S)
    page.get_by_role("slider").first.press("Home")
    wait_for(visited.shows(0.0), LIMIT_S)
