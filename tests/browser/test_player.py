"""The player in a real browser: opened from a file, played, turned, and compared with pictures of the model."""

import io
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from tests.make.models import moving_parts
from tests.pipelines.trained_run import boxed_model, write_trained
from tests.reconstruct.conftest import look_at

from devrf.capture.camera import Camera
from devrf.pipelines.export.export_command import export
from devrf.pipelines.export.player import _told
from devrf.pipelines.export.request import ExportOptions
from devrf.pipelines.player.page import player_page
from devrf.pipelines.terminal.console import Talk
from devrf.reconstruct.kernels.splat import splat
from devrf.reconstruct.rendering.model import render_view
from devrf.reconstruct.splats.gaussians import Gaussians, flattened, tiles_of
from devrf.reconstruct.splats.moving import Nodes
from devrf.reconstruct.splats.packed import pack

pytestmark = pytest.mark.full

SIDE = 320
TITLE = "ball <1>"


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The player of the moving ball, and of one at rest."""
    out = {}
    for name, moves in (("moving", True), ("at rest", False)):
        scene = write_trained(tmp_path_factory.mktemp("ball"), moves=moves)
        options = ExportOptions("player", splats=1500)
        out[name] = export(Talk("quiet"), scene.parent / "run", options, TITLE) / "player.html"
    return out


def opened(page: Any, path: Path) -> list[str]:
    """Open a page of `SIDE` pixels, at a stand; returns what it asked for beside itself."""
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url))
    page.set_viewport_size({"width": SIDE, "height": SIDE})
    page.emulate_media(reduced_motion="reduce")
    page.goto(path.as_uri())
    page.wait_for_selector("body.ready", state="attached")
    page.add_style_tag(content="header, details, #bar, #scale { opacity: 0 }")
    return [url for url in asked if url != path.as_uri()]


def picture(page: Any) -> np.ndarray:
    """What the canvas shows once it has been drawn with all its pixels, in [0, 1]."""
    page.evaluate("player.changed()")
    page.wait_for_timeout(400)
    page.wait_for_function("player.state.share === 1")
    page.wait_for_timeout(200)
    with Image.open(io.BytesIO(page.screenshot())) as image:
        return np.asarray(image.convert("RGB")).astype(np.float32) / 255


def camera_of(page: Any) -> Camera:
    """The camera that the page draws with, in the box frame."""
    view = page.evaluate("player.orbit.view(player.canvas.width, player.canvas.height)")
    (fx, fy), (cx, cy) = view["focal"], view["centre"]
    pose = np.column_stack([np.reshape(view["turn"], (3, 3)), view["shift"]])
    return Camera(SIDE, SIDE, np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]), pose)


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(-10 * np.log10(((a - b) ** 2).mean()))


def test_it_shows_what_the_model_shows(page: Any, pages: dict[str, Path]) -> None:
    assert opened(page, pages["moving"]) == [] and pages["moving"].stat().st_size < 1_000_000
    assert page.title() == TITLE and page.text_content("h1") == TITLE
    model, seen = boxed_model(), {}
    for view in (0, 2):
        page.evaluate(f"player.show({view})")
        for moment in (0.0, 1.0):
            page.evaluate(f"player.setTime({moment})")
            seen[view, moment] = picture(page)
            true = render_view(model, camera_of(page), moment)
            assert psnr(seen[view, moment], true) > 25, (view, moment)
    assert psnr(seen[0, 0.0], seen[0, 1.0]) < 22 and psnr(seen[0, 0.0], seen[2, 0.0]) < 40


def test_rigid_parts_turn_as_the_model_does(page: Any, tmp_path: Path) -> None:
    model = moving_parts()
    run = write_trained(tmp_path, model=model).parent / "run"
    folder = export(Talk("quiet"), run, ExportOptions("player", splats=3000, times="0s,1s"))
    opened(page, folder / "player.html")
    assert page.evaluate("player.about.start") == 1.0  # farthest from where they rest, at 0.375
    seen = {}
    for moment in (0.0, 0.5, 1.0):  # between them it turns along the arc
        page.evaluate(f"player.setTime({moment})")
        seen[moment] = picture(page)
        true = render_view(model, camera_of(page), moment)
        assert psnr(seen[moment], true) > 22, moment
    assert psnr(seen[0.0], seen[0.5]) < 18 and psnr(seen[0.5], seen[1.0]) < 18


def test_a_needle_turns_with_its_node(page: Any, tmp_path: Path) -> None:
    turn, middle = np.pi / 2, torch.tensor([[0.0, 0, 0], [0.2, -0.1, 0.1]])
    needles = Gaussians(
        torch.tensor([[0.3, -0.1, 0.1], [-0.5, 0.1, -0.2]]),
        torch.tensor([[1.0, 0, 0, 0]]).repeat(2, 1),
        torch.tensor([[0.3, 0.02, 0.02]]).log().repeat(2, 1),
        torch.tensor([0.9, 0.9]).logit(),
        torch.tensor([[0.8, 0.2, 0.2], [0.2, 0.2, 0.8]]),
    )

    def nodes(times: list[float]) -> Nodes:
        quats = torch.tensor(
            [[[1.0, 0, 0, 0], [np.cos(turn * t / 2), 0, 0, np.sin(turn * t / 2)]] for t in times]
        )
        places = torch.stack(
            [middle + torch.tensor([[0.0], [t]]) * torch.tensor([0.0, 0.1, 0.2]) for t in times]
        )
        return Nodes(torch.tensor([1, 0]), middle, quats.float(), places)

    keys = nodes([0.0, 1.0])
    ways = torch.stack([keys.at(key, needles).places[:1] for key in (0, 1)])
    packed = pack(needles, ways, keys)
    view = _told("start", look_at(np.array([0.3, -2.0, 1.2])), np.zeros(3))
    about = {
        "up": [0, 0, 1],
        "behind": [1, 1, 1],
        "metres": None,
        "times": [0.0, 1.0],
        "start": 0.0,
        "views": [view],
    }
    path = tmp_path / "player.html"
    path.write_text(player_page("needle", "", about | {"splats": packed.about}, packed.data))
    opened(page, path)
    for moment in (0.0, 0.5, 1.0):
        page.evaluate(f"player.setTime({moment})")
        shown = picture(page)
        flat, depth, spread = flattened(nodes([moment]).at(0, needles), camera_of(page))
        lists = tiles_of(flat, depth, spread, (SIDE, SIDE))
        true = splat(flat, *lists, (SIDE, SIDE), torch.ones(3)).numpy()
        assert psnr(shown, true) > 40, moment


def test_mouse_keys_and_touch_move_it(page: Any, pages: dict[str, Path]) -> None:
    opened(page, pages["moving"])
    page.evaluate("player.setTime(0)")
    model, centre = boxed_model(), SIDE / 2

    def eye() -> np.ndarray:
        return np.array(page.evaluate("player.orbit.eye"))

    first, target = eye(), np.array(page.evaluate("player.orbit.target"))
    page.mouse.move(centre, centre)
    page.mouse.down()
    page.mouse.move(centre + 60, centre - 20, steps=4)
    page.mouse.up()
    turned = eye()
    assert np.linalg.norm(turned - first) > 0.3
    assert np.linalg.norm(turned - target) == pytest.approx(np.linalg.norm(first - target), rel=1e-6)
    assert psnr(picture(page), render_view(model, camera_of(page), 0.0)) > 25
    page.mouse.move(centre, centre / 2)
    page.mouse.wheel(0, 400)
    page.wait_for_function(f"player.orbit.distance > {1.2 * np.linalg.norm(turned - target)}")
    page.keyboard.press("0")
    np.testing.assert_allclose(eye(), first)
    page.keyboard.press("Shift+ArrowLeft")
    assert np.linalg.norm(np.array(page.evaluate("player.orbit.target")) - target) > 0.02
    page.keyboard.press("ArrowUp")
    page.keyboard.press("2")
    assert page.input_value("#view") == "2" and page.evaluate("player.about.views[2].name") == "cam1"
    page.keyboard.press(".")
    assert page.evaluate("player.state.time") == 0.5
    assert page.inner_text("#clock") == "0.50 s"


def test_keys_are_heard_after_the_bar_was_used(page: Any, pages: dict[str, Path]) -> None:
    opened(page, pages["moving"])
    box = page.locator("#time").bounding_box()
    page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    assert 0.3 < page.evaluate("player.state.time") < 0.7
    eye = page.evaluate("player.orbit.eye")
    page.keyboard.press("ArrowRight")  # the slider's own
    assert page.evaluate("player.orbit.eye") == eye
    page.keyboard.press(".")
    assert page.evaluate("player.state.time") in (0.5, 1.0)
    page.keyboard.press("2")
    assert page.input_value("#view") == "2"
    for playing in (True, False):
        page.keyboard.press(" ")
        assert page.evaluate("player.state.playing") is playing
    page.click("#play")  # has the focus now: Space is its own, and heard once
    assert page.evaluate("player.state.playing")
    page.keyboard.press(" ")
    assert not page.evaluate("player.state.playing")


def test_it_plays(page: Any, pages: dict[str, Path]) -> None:
    opened(page, pages["moving"])
    page.evaluate("player.setTime(0)")
    page.select_option("#speed", "0.5")
    assert not page.evaluate("player.state.playing")  # as a reader who wants reduced motion asks
    page.focus("#canvas")
    page.keyboard.press(" ")
    begin, before = time.monotonic(), page.evaluate("player.state.pictures")
    page.wait_for_function("player.state.time > 0.3")
    page.wait_for_function("player.state.time < 0.2")  # it goes round
    assert time.monotonic() - begin > 1.5  # a second at half speed is two; the first picture may come late
    assert page.evaluate("player.state.pictures") > before + 10
    page.keyboard.press(" ")
    still = page.evaluate("player.state.time")
    page.wait_for_timeout(200)
    assert page.evaluate("player.state.time") == still


def test_a_scene_at_rest_has_no_slider(page: Any, pages: dict[str, Path]) -> None:
    opened(page, pages["at rest"])
    assert page.is_hidden("#time") and page.is_hidden("#play") and not page.is_hidden("canvas")
    assert psnr(picture(page), render_view(boxed_model(), camera_of(page), None)) > 25
    names = page.eval_on_selector_all("#view option", "all => all.map((one) => one.textContent)")
    assert names == ["start", "sweep 1", "sweep 2", "sweep 3", "sweep 4"]


def test_on_a_phone_in_the_dark(browser: Any, pages: dict[str, Path]) -> None:
    context = browser.new_context(
        viewport={"width": 360, "height": 640}, device_scale_factor=2, color_scheme="dark", has_touch=True
    )
    page = context.new_page()
    page.goto(pages["moving"].as_uri())
    page.wait_for_selector("body.ready", state="attached")
    assert page.evaluate("document.documentElement.scrollWidth") <= 360
    for name in ("#play", "#time", "#speed", "#view"):
        box = page.locator(name).bounding_box()
        assert box["x"] >= 0 and box["x"] + box["width"] <= 360 and box["y"] + box["height"] <= 640
        assert box["height"] >= 28  # large enough for a finger
    ink, page_colour = (
        page.evaluate(f"getComputedStyle(document.body).{part}") for part in ("color", "backgroundColor")
    )
    assert ink == "rgb(236, 238, 242)" and page_colour == "rgb(15, 16, 19)"
    context.close()


@pytest.mark.parametrize(
    ("missing", "named"),
    [
        ("HTMLCanvasElement.prototype.getContext = () => null", "WebGL 2"),
        ("delete window.DecompressionStream", "DecompressionStream"),
    ],
)
def test_a_browser_that_cannot_is_told(page: Any, pages: dict[str, Path], missing: str, named: str) -> None:
    page.add_init_script(missing)
    page.goto(pages["at rest"].as_uri())
    page.wait_for_selector("#message:not([hidden])")
    assert named in page.inner_text("#message") and page.is_hidden("#bar")
