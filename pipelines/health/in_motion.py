"""Health rows about the motion that was learned, by the pictures of the training cameras alone."""

from collections.abc import Callable, Iterator, Mapping
from statistics import fmean

from devrf.pipelines.health.rows import HealthRow, listed, row
from devrf.reconstruct.check_motion import MotionFit

LEAST_GAIN_DB = 1.0  # of pictures never trained on; motion that gains less is not worth its name
LEAST_TRAINED_GAIN_DB = 1.5  # what was trained on flatters: others gain as little as 0.6 of it
MOST_UNREACHABLE = 0.5  # of the error at rest: motion can then halve the error at best
# Of that error: eight captures and data sets in which all that moves is found have at most 0.045, three others 0.10 and
# more (docs/stability.md).
MOST_UNMOVED = 0.08
MOST_ALONE = 0.75  # of the surface; around a ball four cameras leave none of it, three half, one all
MOST_SHIFT = 0.25  # pictures; as for the check of clocks by geometry


@listed
def in_motion_rows(cameras: Mapping[str, MotionFit]) -> Iterator[HealthRow]:
    """Rows about the worst camera; none where no camera's pictures change."""
    if not cameras:
        return
    least = min(cameras, key=lambda name: cameras[name].gain_db)
    yield row(
        f"gain of motion in training pictures, worst camera ({least})",
        cameras[least].gain_db,
        "dB",
        warn=LEAST_TRAINED_GAIN_DB,
        remedy=f"The motion does not explain what {least} sees, though it was trained on it: check the clock and "
        f"the pose of {least}, that its clip begins with the scene as in the sweep (capture.rest) and that the box "
        "holds all that moves; slow the motion down or raise the frame rate.",
    )
    name, share = _worst(cameras, lambda fit: fit.unreachable)
    yield row(
        f"change where the model is empty, worst camera ({name})",
        100 * share,
        "%",
        warn_above=100 * MOST_UNREACHABLE,
        remedy=f"Much of what changes in {name} is not in the box, at rest or in motion: keep people, shadows and "
        "other moving things out of the picture, keep the subject near where it rests, and let two cameras see all "
        "of its way so that the box is made larger.",
    )
    name, share = _worst(cameras, lambda fit: fit.unmoved)
    yield row(
        f"change where the model stands still, worst camera ({name})",
        100 * share,
        "%",
        warn_above=100 * MOST_UNMOVED,
        remedy=f"Something changes in {name} and was not found to move, or was not there in the sweep: keep people, "
        "shadows and things that come later out of the pictures, keep lights still, and give what moves a pattern "
        "unlike that of what is behind it.",
    )
    alone = [fit.alone for fit in cameras.values() if fit.alone is not None]
    if alone:
        yield row(
            "moving surface that is seen from one side only",
            100 * fmean(alone),
            "%",
            warn_above=100 * MOST_ALONE,
            remedy="What only one camera sees, or several from one place, moves at a depth that is a guess, and "
            "other views show it wrong: add cameras (four, around the subject), or move them apart so that each "
            "side of the subject is in two pictures.",
        )
    name, shift = _worst(cameras, lambda fit: abs(fit.better_at))
    yield row(
        f"pictures by which the motion fits better at another time, worst camera ({name})",
        shift,
        "pictures",
        warn_above=MOST_SHIFT,
        remedy=f"The clock of {name} disagrees with those of the other cameras: film with sound and clap a few "
        "times near the middle, or flash a light.",
    )


def _worst(cameras: Mapping[str, MotionFit], value: Callable[[MotionFit], float]) -> tuple[str, float]:
    """The camera with the largest value, and the value."""
    name = max(cameras, key=lambda n: value(cameras[n]))
    return name, value(cameras[name])
