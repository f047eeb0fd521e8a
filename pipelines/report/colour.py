"""The report's colour section: how far each camera was from the reference's look, and a picture before and after."""

from typing import Any

from devrf.capture.frames import SWEEP
from devrf.pipelines.report.html import absent, figure, number, section, table, text
from devrf.pipelines.report.pictures import picture_uri, read_picture
from devrf.pipelines.report.run import RunFolder

COLOUR = "colour/colour.json"
WIDTH_PX = 280
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
        "How far cameras lie apart on points kept out of the fit, and what brings them to one look: in linear light, "
        "when pictures are loaded. Of a test camera's own pictures nothing is fitted."
    )
    cameras = run.cameras(COLOUR)
    if not cameras:
        return section("colour", "Colours", lead, absent(run.why_absent("colour")))
    rows = [_row(name, camera) for name, camera in cameras.items() if name != SWEEP]
    head = (
        "camera",
        "against the reference",
        "by",
        "correction",
        "points fitted",
        "kept out",
        "before",
        "after",
    )
    body = table(head, rows, source=COLOUR, numeric=(1, 4, 5, 6, 7))
    return section("colour", "Colours", lead, body + _strip(run))


def _row(name: str, camera: dict[str, Any]) -> list[str]:
    key = f"cameras.{name}"

    def of(entry: str, value: object, unit: str, digits: int, sign: bool = False) -> str:
        return number(value, unit, digits, file=COLOUR, key=f"{key}.{entry}", sign=sign)

    apart = camera.get("apart") or {}
    return [
        f"<strong>{text(name)}</strong>",
        of("stops", camera.get("stops"), "EV", 2, sign=True) if camera.get("source") != "reference" else "",
        text(SOURCES.get(str(camera.get("source")), "")),
        text(KINDS.get(str(camera.get("kind")), "")),
        of("fitted", camera.get("fitted"), "", 0),
        of("apart.points", apart.get("points"), "", 0),
        of("apart.before", apart.get("before"), "", 3) if apart.get("points") else "",
        of("apart.after", apart.get("after"), "", 3) if apart.get("points") else "",
    ]


def _strip(run: RunFolder) -> str:
    """The first picture of each corrected camera, as filmed and as it is used."""
    first = {f.camera_name: f for f in reversed(run.scene.dynamic if run.scene else ()) if f.look is not None}
    figures = []
    for name in sorted(first)[:MOST_SHOWN]:
        frame = first[name]
        picture = read_picture(frame.path)
        if picture is None or frame.look is None:
            continue
        for shown, how in ((picture, "as filmed"), (frame.look.apply(picture), "as used")):
            caption = f"{name}, {how}"
            figures.append(figure(picture_uri(shown, WIDTH_PX), text(caption), caption))
    return f'<div class="strip">{"".join(figures)}</div>' if figures else ""
