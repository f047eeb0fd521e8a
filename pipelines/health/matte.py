"""What mattes say of themselves, as rows: the worst camera each."""

from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np

from devrf.capture.mattes.given import SWEEP
from devrf.capture.mattes.make import CameraMattes
from devrf.capture.mattes.measure import LEAST_SUBJECT
from devrf.pipelines.health.rows import HealthRow, listed, note, row
from devrf.pipelines.scene_mattes import SceneMattes

MOST_EMPTY = 0.5  # of a camera's pictures; a subject may walk in and out
MOST_AREA = 0.9  # of a picture: all of it is no subject
MOST_HOLES = 0.01  # of the subject's area
MOST_RIM = 0.5  # of the outermost pixels; of a matte that is right to the pixel they mix both
# of the screen's colour on the subject, well within its edge; from 0.2 on mattes let through
MOST_SPILL = 0.05


@listed
def matte_health(mattes: SceneMattes, method: str) -> Iterator[HealthRow]:
    """Rows about the mattes of a scene."""
    made = mattes.cameras
    acts = (
        "of every picture: the subject is modelled before a plain background"
        if mattes.everywhere
        else "of the moving cameras: they tell where the subject is; the surroundings are modelled as without"
    )
    yield note("mattes", f"{method}, {acts} ({', '.join(made)})")
    yield from _inverted(made)
    yield from _screens(made)
    name, empty = _worst(made, lambda m: float(np.mean([f.area < LEAST_SUBJECT for f in m.facts])))
    yield row(
        f"pictures without a subject ({name})", empty, "of the camera's", warn_above=MOST_EMPTY,
        remedy=f"The mattes of {name} are nearly all empty: look at scene/mattes/{name}, and check the method.",
    )  # fmt: skip
    name, area = _worst(made, lambda m: float(np.median([f.area for f in m.facts])))
    yield row(
        f"subject's share of the picture ({name})", area, "", warn_above=MOST_AREA,
        remedy=f"The mattes of {name} are nearly all subject: look at scene/mattes/{name}; white is the subject.",
    )  # fmt: skip
    name, holes = _worst(made, lambda m: float(np.median([f.holes for f in m.facts])))
    yield row(
        f"holes in mattes ({name})", 100 * holes, "% of the subject", warn_above=100 * MOST_HOLES,
        remedy=f"The subject has holes in scene/mattes/{name}, and the model will: close them, or use another "
        "method (the subject may have the background's or the screen's colour).",
    )  # fmt: skip
    name, rim = _worst(made, lambda m: _median([f.rim for f in m.facts]))
    if not np.isnan(rim):
        yield row(
            f"rim of the background's colour ({name})", 100 * rim, "% of the edge", warn_above=100 * MOST_RIM,
            remedy=f"The mattes of {name} reach beyond the subject and the model gets a rim: shrink them by a "
            "pixel or two.",
        )  # fmt: skip
    name, spill = _worst(made, lambda m: np.nan if m.spill is None else m.spill)
    if not np.isnan(spill):
        yield row(
            f"screen's colour on the subject ({name})", 100 * spill, "%", warn_above=100 * MOST_SPILL,
            remedy="The screen shines on the subject, or they share a colour: move the subject away from the "
            "screen, light it from behind, or use a screen of another colour.",
        )  # fmt: skip


def _inverted(made: Mapping[str, CameraMattes]) -> Iterator[HealthRow]:
    swapped = [name for name, mattes in made.items() if mattes.inverted]
    if not swapped:
        return
    yield note(
        "mattes' black and white",
        f"swapped: {', '.join(swapped)}",
        remedy="They are white around and darker inside and were inverted: save the subject white, or say so "
        "(capture.mattes.inverted: true, or false if that is wrong).",
    )


def _screens(made: Mapping[str, CameraMattes]) -> Iterator[HealthRow]:
    """Which colour each camera's screen has; a colour that was found and can be no screen's fails."""
    keys = {name: mattes.key_rgb for name, mattes in made.items() if mattes.key_rgb is not None}
    if not keys:
        return
    colours = {
        name: f"{name} #{''.join(f'{round(value):02x}' for value in key)}" for name, key in keys.items()
    }
    doubtful = [colours[name] for name in keys if made[name].doubtful_key]
    yield note(
        "the screen's colour",
        ", ".join(colours.values()),
        verdict="fail" if doubtful else "ok",
        remedy=f"The commonest strong colour is neither a green nor a blue screen's ({', '.join(doubtful)}) and "
        "may be the subject: film before a green or blue screen, name the screen's colour (capture.mattes: "
        "{method: chroma, colour: '#00b140'}), or use another method."
        if doubtful
        else "",
    )


def _worst(made: Mapping[str, CameraMattes], value: Callable[[CameraMattes], float]) -> tuple[str, float]:
    """The camera with the largest value, and that; values that are NaN lose."""
    values = {name: value(mattes) for name, mattes in made.items()}
    name = max(values, key=lambda n: -np.inf if np.isnan(values[n]) else values[n])
    return ("sweep" if name == SWEEP else name), float(values[name])


def _median(values: Sequence[float | None]) -> float:
    known = [v for v in values if v is not None]
    return float(np.median(known)) if known else float("nan")
