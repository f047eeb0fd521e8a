"""Pictures of the viewer and the player, from a finished run of the example, in Chromium.

python docs/site/screens.py SCENE_YAML PLAYER_HTML   # docs/viewer.png, docs/player.png
"""

import subprocess
import sys
from pathlib import Path
from shutil import which

from playwright.sync_api import sync_playwright

DOCS = Path(__file__).resolve().parents[1]
FLAGS = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
TIME_S = 1.5
SHARP_MS = 25_000  # until the viewer has drawn with all pixels


def main(scene: Path, player: Path) -> None:
    """Open both and photograph them."""
    command = [sys.executable, "-m", "devrf", "view", str(scene), "--port", "8099"]
    with sync_playwright() as play, subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as viewer:
        chromium = play.chromium.launch(executable_path=which("chromium"), args=list(FLAGS))
        try:
            page = chromium.new_page(viewport={"width": 960, "height": 600}, reduced_motion="reduce")
            page.goto(player.resolve().as_uri())
            page.wait_for_selector("body.ready")
            page.wait_for_timeout(5000)
            page.screenshot(path=DOCS / "player.png")
            assert viewer.stdout is not None
            viewer.stdout.readline()  # the address: it listens
            page = chromium.new_page(viewport={"width": 1024, "height": 576})
            page.goto("http://127.0.0.1:8099")
            page.wait_for_timeout(SHARP_MS)
            for close in page.locator(".mantine-Notification-closeButton").all():
                close.click()  # that WebGL is drawn by software
            number = page.locator("input[type=text], input[type=number]").first
            number.fill(str(TIME_S))
            number.press("Enter")
            page.wait_for_timeout(SHARP_MS)
            page.screenshot(path=DOCS / "viewer.png")
        finally:
            viewer.terminate()
            chromium.close()


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
