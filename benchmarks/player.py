"""Pictures a second of a player page in software WebGL, and its pictures against the model's: docs/player.md.

    devrf-pipeline export scene.yaml --format player
    python -m benchmarks.player run/export/player/player.html run [--json FILE]     # from the repository's root

The browser is Debian's Chromium with SwiftShader, the picture 400 x 400; what the page draws by requestAnimationFrame
is counted for some seconds. Pictures are compared with `render_view` of the same camera and time.
"""

import io
from pathlib import Path
from typing import Any

import numpy as np
from benchmarks.script import arguments, finish
from PIL import Image
from tests.browser.conftest import FLAGS

from devrf.capture.camera import Camera
from devrf.capture.formats import read_scene
from devrf.lab.bench.bench_rows import Row
from devrf.reconstruct.evaluation.metrics import psnr
from devrf.reconstruct.rendering.model import render_view
from devrf.reconstruct.storage.model_io import load_model

SIDE, SECONDS, GOAL = 400, 6, 20
MOST_MB = 25
MOMENTS = 3
TURN = """() => {
  const step = () => { player.orbit.turn(0.01, 0); player.changed(); window.turning = requestAnimationFrame(step); };
  step();
}"""


def main() -> None:
    """Measure the page that the arguments name, print the rows and write them."""
    chosen = arguments(__doc__, "page", "run")
    page_path = chosen.page.resolve()
    from playwright.sync_api import sync_playwright

    with sync_playwright() as play:
        browser = play.chromium.launch(executable_path="/usr/bin/chromium", args=list(FLAGS))
        page = browser.new_page(viewport={"width": SIDE, "height": SIDE}, reduced_motion="reduce")
        page.goto(page_path.as_uri())
        page.wait_for_selector("body.ready", state="attached", timeout=120_000)
        size = Row("player/size", round(page_path.stat().st_size / 1e6, 2), "MB").at_most(MOST_MB)
        rows = [size, *_pictures_a_second(page), *_compared(page, chosen.run)]
        browser.close()
    finish("player", rows, chosen.json)


def _pictures_a_second(page: Any) -> list[Row]:
    """While it plays, is turned, and both."""
    rows = []
    for what, script in (
        ("playing", "player.setPlaying(true)"),
        ("playing and turned", TURN),
        ("turned", "player.setPlaying(false)"),
    ):
        page.evaluate(script)
        rows += _counted(page, what)
    page.evaluate("cancelAnimationFrame(window.turning)")
    return rows


def _counted(page: Any, what: str) -> list[Row]:
    page.wait_for_timeout(2000)  # it finds out how many pixels it can draw
    before, begin = page.evaluate("[player.state.pictures, performance.now()]")
    page.wait_for_timeout(1000 * SECONDS)
    after, end, share, drawn = page.evaluate(
        "[player.state.pictures, performance.now(), player.state.share, player.state.drawn]"
    )
    rate = round(1000 * (after - before) / (end - begin), 1)
    return [
        Row(f"player/{what}", rate, "pictures/s").at_least(GOAL),
        Row(f"player/{what}, side of the pixels drawn", round(SIDE * share), "px"),
        Row(f"player/{what}, splats drawn", drawn, "splats"),
    ]


def _compared(page: Any, run_dir: Path) -> list[Row]:
    """Screenshots against the model, for every view of the page."""
    model = load_model(run_dir, "cpu")
    scene = read_scene(run_dir / "scene")
    page.add_style_tag(content="header, details, #bar, #scale { opacity: 0 }")
    rows = []
    for n, name in enumerate(page.evaluate("player.about.views.map((view) => view.name)")):
        found = []
        for share in np.linspace(0, 1, MOMENTS).tolist():
            page.evaluate(
                f"player.show({n}); player.setTime({scene.t0_s + share * (scene.t1_s - scene.t0_s)})"
            )
            page.wait_for_timeout(800)
            page.wait_for_function("player.state.share === 1")
            page.wait_for_timeout(1000)
            with Image.open(io.BytesIO(page.screenshot())) as image:
                shown = np.asarray(image.convert("RGB")).astype(np.float32) / 255
            time = (page.evaluate("player.state.time") - scene.t0_s) / (scene.t1_s - scene.t0_s)
            found.append(psnr(shown, render_view(model, _camera(page), time)))
        rows.append(Row(f"player/PSNR against the model, {name}", round(float(np.mean(found)), 2), "dB"))
    return rows


def _camera(page: Any) -> Camera:
    view = page.evaluate("player.orbit.view(player.canvas.width, player.canvas.height)")
    (fx, fy), (cx, cy) = view["focal"], view["centre"]
    pose = np.column_stack([np.reshape(view["turn"], (3, 3)), view["shift"]])
    return Camera(SIDE, SIDE, np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]), pose)


if __name__ == "__main__":
    main()
