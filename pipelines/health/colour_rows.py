"""How far each camera's colours are from the reference's, before and after."""

from collections.abc import Iterator

from devrf.calibration.colour.colours import CameraColour, Colours
from devrf.capture.frames import SWEEP
from devrf.capture.measure import Measure

WORDS = {"gain": "one gain", "diagonal": "three gains", "matrix": "a 3x3 matrix"}
VAGUE_STOPS = 0.1  # standard deviation of a camera's brightness: more than many cameras differ


def colour_measures(colours: Colours) -> Iterator[Measure]:
    """Of all fixed cameras; none where colours stay as they were filmed."""
    target = "the sweep" if colours.reference == SWEEP else colours.reference
    for name, camera in colours.cameras.items():
        if target is None or name in (colours.reference, SWEEP):
            continue
        yield from _camera(name, camera, target)
        if camera.stops_std is not None and camera.stops_std > VAGUE_STOPS:
            facts = {"points": camera.fitted or 0, "target": target}
            text = f"brightness against {target} is known to {camera.stops_std:.2g} EV"
            yield Measure("colours-differ", text, name, "vague", facts)


def _camera(name: str, camera: CameraColour, target: str) -> Iterator[Measure]:
    if camera.apart.after is None or camera.stops is None:
        if camera.source == "none":
            text = "not compared: too few surface points shared with cameras of known look"
            yield Measure("colours-differ", text, name, "none", {"target": target})
        return
    side = "brighter" if camera.stops > 0 else "darker"
    found = f"{abs(camera.stops):.2f} EV {side} than {target}, "
    if camera.source == "none":  # as it is, against the others as they are used
        facts = {"found": f"{found}not corrected", "target": target}
        yield Measure("colours-differ", camera.apart.after, name, "uncorrected", facts)
        return
    how = f"corrected by {WORDS[camera.kind]}" if camera.kind in WORDS else "needs no correction"
    facts = {"found": f"{found}{how} from {camera.source}: left of {camera.apart.before:.3f}"}
    yield Measure("colours-differ", camera.apart.after, name, facts=facts)
