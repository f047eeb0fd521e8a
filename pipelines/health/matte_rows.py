"""What mattes say of themselves: the worst camera each."""

from collections.abc import Iterator

import numpy as np

from devrf.calibration.extent.matted import SceneMattes
from devrf.capture.mattes.given import SWEEP
from devrf.capture.mattes.matte_facts import LEAST_SUBJECT
from devrf.capture.measure import Measure, highest, noted

MOST_AREA = 0.9  # of a picture: all of it is no subject


def matte_measures(mattes: SceneMattes) -> Iterator[Measure]:
    """Whether mattes show a subject, and whether the screen is one."""
    made = mattes.cameras
    swapped = [name for name, of in made.items() if of.inverted]
    if swapped:
        yield Measure("matte-empty", f"black and white swapped: {', '.join(swapped)}", why="inverted")
    shifted = [name for name, of in made.items() if of.from_1]
    text = f"{', '.join(shifted)}: numbered from 1 to the number of pictures, so that 1 is that of the first"
    yield from noted([text] if shifted else [], "mattes")
    doubtful = {name: of.key_rgb for name, of in made.items() if of.key_rgb is not None and of.doubtful_key}
    if doubtful:
        colours = ", ".join(
            f"{name} #{''.join(f'{round(value):02x}' for value in key)}" for name, key in doubtful.items()
        )
        yield Measure("screen-colour", colours, facts={"doubtful": colours}, found="fail")
    areas = {"sweep" if name == SWEEP else name: [f.area for f in of.facts] for name, of in made.items()}
    yield highest(
        "matte-empty",
        {
            name: max(float(np.mean(np.less(of, LEAST_SUBJECT))), float(np.mean(np.greater(of, MOST_AREA))))
            for name, of in areas.items()
        },
    )
