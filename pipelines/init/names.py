"""What the names of files tell of their roles, and names for cameras out of them."""

import re
import unicodedata
from pathlib import Path

from devrf.capture.system.file_names import safe
from devrf.pipelines.config.scene import LONGEST_CAMERA, RESERVED_NAMES, RESERVED_PREFIXES, is_camera_name

WORDS: dict[str, tuple[str, ...]] = {  # what crews call things; the first that fits counts
    "board": ("board", "charuco", "calib", "checker", "chess", "aruco", "intrinsic", "extrinsic"),
    "white": ("white", "flatfield", "vignett"),
    "chart": ("chart", "colorcheck", "colourcheck", "macbeth"),
    "matte": ("matte", "mask"),
    "sweep": ("static", "sweep", "room", "scan", "walk", "orbit", "rest"),
    "test": ("witness", "test", "holdout", "heldout", "eval"),
    "camera": ("cam", "gopro", "view", "phone", "left", "right"),
}
SHORT = 60  # characters of a name; a number may follow
BY_NAME = {  # what no content tells; role -> why it is not used
    "white": "a white sheet by its name",
    "chart": "a colour chart by its name",
    "matte": "mattes by their name; to use them, name the folder in capture.mattes",
}


def called(name: str) -> str:
    """The role that a name tells: `room/cam0.mp4` is a camera; empty where it tells none."""
    return next(iter(roles_called(name)), "")


def roles_called(name: str) -> list[str]:
    """The roles that the parts of a name tell, the last part's first."""
    roles = []
    for part in reversed(_without_suffix(name.lower()).split("/")):
        tokens = re.findall(r"[a-z]+", part)
        roles += [r for r, words in WORDS.items() if any(t.startswith(words) for t in tokens)][:1]
    return roles


def words_of(name: str) -> list[str]:
    """Its letters and numbers, one by one: `GoPro_2/cam1.mp4` has gopro, 2, cam, 1."""
    return re.findall(r"[^\W\d_]+|\d+", _without_suffix(unicodedata.normalize("NFC", name.lower())))


def camera_name(name: str, taken: set[str]) -> str:
    """A name for a camera out of its file's, or its folder's where that is the telling one."""
    path = Path(name)
    stem = path.stem
    if called(stem) not in ("camera", "test") and called(path.parent.name) in ("camera", "test"):
        stem = path.parent.name
    stem = safe(stem).strip("_-")[:SHORT] or "cam"
    if stem in RESERVED_NAMES or stem.startswith(RESERVED_PREFIXES):
        stem = f"cam_{stem}"
    folder = safe(path.parent.name).strip("_-")
    tries = [stem, f"{folder}_{stem}"[:LONGEST_CAMERA], *(f"{stem}_{n}" for n in range(2, 1000))]
    return next(t for t in tries if t not in taken and is_camera_name(t))


def _without_suffix(name: str) -> str:
    return re.sub(r"\.\w+$", "", name)
