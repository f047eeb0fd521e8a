"""Health rows about colours: how far each camera is from the reference's look, before and after."""

from collections.abc import Iterator

from devrf.calibration.colour.result import CameraColour, Colours
from devrf.capture.frames import SWEEP
from devrf.pipelines.health.rows import HealthRow, listed, note, row

WORDS = {"gain": "one gain", "diagonal": "three gains", "matrix": "a 3x3 matrix"}
UNIT = "of 1, rms of sRGB"
MIXED = 0.05  # rms of sRGB: from here on seams between cameras are seen in renderings
VAGUE_STOPS = 0.1  # standard deviation of a camera's brightness: more than many cameras differ


@listed
def colour_rows(colours: Colours, test_cameras: set[str]) -> Iterator[HealthRow]:
    """Rows about all fixed cameras."""
    if colours.reference is None:
        yield note("colours", "as filmed (calibration.colour.method: none)")
        return
    target = "the sweep" if colours.reference == SWEEP else colours.reference
    for name, camera in colours.cameras.items():
        if name in (colours.reference, SWEEP):
            continue
        yield _camera(name, camera, target, name in test_cameras)
        if camera.stops_std is not None and camera.stops_std > VAGUE_STOPS:
            yield row(
                f"brightness of {name} against {target}, standard deviation",
                camera.stops_std,
                "EV",
                warn_above=VAGUE_STOPS,
                remedy=f"{camera.fitted} points say little: let its view overlap more with that of {target}.",
            )
    if not set(colours.cameras) - {colours.reference, SWEEP}:
        yield note("colours", f"only {target}: nothing to compare with")


def _camera(name: str, camera: CameraColour, target: str, test: bool) -> HealthRow:
    if camera.apart.after is None or camera.stops is None:
        if camera.source != "none":
            return note(
                f"colours of {name}", f"corrected by {WORDS.get(camera.kind, 'nothing')} from {camera.source}"
            )
        text = "not compared: too few surface points shared with cameras of known look"
        remedy = f"Let the views of {name} and {target} overlap more."
        return note(f"colours of {name}", text, remedy=remedy)
    side = "brighter" if camera.stops > 0 else "darker"
    found = f"{name} {abs(camera.stops):.2f} EV {side} than {target}"
    if camera.source == "none":
        why = "not corrected: of test pictures nothing is fitted" if test else "not corrected"
        return row(
            f"{found}, {why}",
            camera.apart.after,  # as it is, against the others as they are used
            UNIT,
            warn_above=MIXED,
            remedy=f"Set the same exposure, white balance and picture profile by hand on {name} and {target}.",
        )
    how = f"corrected by {WORDS[camera.kind]}" if camera.kind in WORDS else "needs no correction"
    return row(
        f"{found}, {how} from {camera.source}: left of {camera.apart.before:.3f}",
        camera.apart.after,
        UNIT,
        warn_above=MIXED,
        remedy="Set the same exposure, white balance and picture profile by hand on all cameras.",
    )
