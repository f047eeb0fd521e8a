"""The player as one HTML file: page, style and script of this folder, with what a scene brings put in."""

import base64
import html
import json
import re
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).parent
SCRIPTS = ("splats.js", "draw.js", "camera.js", "controls.js", "player.js")  # each uses those before it
# of modules; async is put back
BORDERS = re.compile(r"^import .*\n|^export (async )?(?=class|function)", re.M)


def player_page(title: str, subtitle: str, about: dict[str, Any], data: bytes) -> str:
    """The whole page.

    Args:
        title, subtitle: What it says it is.
        about: What the script is told (`player.js`).
        data: Packed splats.
    """
    parts = {
        "title": html.escape(title),
        "subtitle": html.escape(subtitle),
        "style": (FOLDER / "player.css").read_text(encoding="utf-8"),
        "about": _json(about),
        "splats": base64.b64encode(data).decode(),
        "script": "\n".join(_joined((FOLDER / name).read_text(encoding="utf-8")) for name in SCRIPTS),
    }
    page = (FOLDER / "player.html").read_text(encoding="utf-8")
    return re.sub(r"\{\{(\w+)\}\}", lambda found: parts[found[1]], page)


def page_size(data: int, about: int = 0) -> int:
    """Bytes of a page that carries so many bytes of packed splats and of words."""
    own = sum((FOLDER / name).stat().st_size for name in (*SCRIPTS, "player.css", "player.html"))
    return own + about + -(-data // 3) * 4


def _joined(script: str) -> str:
    """A module as a part of one script."""
    return BORDERS.sub(lambda found: found[1] or "", script)


def _json(value: dict[str, Any]) -> str:
    return json.dumps(value, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
