"""The report's colour section: how far each camera was from the reference's look, and pictures half and half."""

from typing import Any

import numpy as np

from devrf.capture.frames import SWEEP
from devrf.pipelines.report.html import absent, figure, number, section, table, text
from devrf.pipelines.report.pictures import picture_uri, read_picture
from devrf.pipelines.report.run import RunFolder

COLOUR = "colour/colour.json"
WIDTH_PX = 380
MOST_SHOWN = 8  # cameras in the strip
KINDS = {"none": "none", "gain": "one gain", "diagonal": "three gains", "matrix": "3×3 matrix"}
SOURCES = {
    "reference": "the reference",
    "chart": "chart",
    "points": "surface points",
    "none": "not corrected",
}


def colour_section(run: RunFolder) -> str:
    """Table of the cameras and the strip."""
    lead = (
        "How far cameras lie apart, rms of sRGB in [0, 1] on points kept out of the fit, and what brings them to one "
        "look: in linear light, when pictures are loaded. Of a test camera's own pictures nothing is fitted."
    )
    cameras = run.cameras(COLOUR)
    if not cameras:
        return section("colour", "Colours", lead, absent(run.why_absent("colour")))
    rows = [_row(name, camera) for name, camera in cameras.items() if name != SWEEP]
    if not rows:
        return section("colour", "Colours", lead, absent("Only the sweep: nothing to compare with."))
    by_sweep = cameras.get(SWEEP, {}).get("source") == "reference"
    against = "against the sweep" if by_sweep else "against the reference"
    head = ("camera", against, "by", "correction", "points fitted", "kept out", "before", "after")
    body = table(head, rows, source=COLOUR, numeric=(1, 4, 5, 6, 7))
    return section("colour", "Colours", lead, body + _strip(run))


def _row(name: str, camera: dict[str, Any]) -> list[str]:
    def of(entry: str, unit: str, digits: int, *, sign: bool = False) -> str:
        value: Any = camera
        for key in entry.split("."):
            value = (value or {}).get(key)
        return number(value, unit, digits, file=COLOUR, key=f"cameras.{name}.{entry}", sign=sign)

    source = camera.get("source")
    compared = bool((camera.get("apart") or {}).get("points"))
    return [
        f"<strong>{text(name)}</strong>",
        of("stops", "EV", 2, sign=True) if source != "reference" else "",
        text(SOURCES.get(str(source), "")),
        text(KINDS.get(str(camera.get("kind")), "")) if source in ("chart", "points") else "",
        of("fitted", "", 0) if source in ("chart", "points") else "",
        of("apart.points", "", 0) if compared else "",
        of("apart.before", "", 3) if compared else "",
        of("apart.after", "", 3) if compared else "",
    ]


def _strip(run: RunFolder) -> str:
    """The first picture of each corrected camera: its left half as filmed, its right half as it is used."""
    first = {f.camera_name: f for f in reversed(run.scene.dynamic if run.scene else ()) if f.look is not None}
    figures = []
    for name in sorted(first)[:MOST_SHOWN]:
        frame = first[name]
        picture = read_picture(frame.path)
        if picture is None or frame.look is None:
            continue
        middle = picture.shape[1] // 2
        halves = np.concatenate([picture[:, :middle], frame.look.apply(picture)[:, middle:]], axis=1)
        caption = f"{name}: left as filmed, right as used"
        figures.append(figure(picture_uri(halves, WIDTH_PX), text(caption), caption))
    return f'<div class="strip">{"".join(figures)}</div>' if figures else ""
