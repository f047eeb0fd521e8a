"""What `check` says of a sweep and of fixed cameras: its measures, judged."""

from collections.abc import Sequence

import numpy as np

from devrf.calibration.field.fixed import FixedGlance
from devrf.calibration.field.steady import STANDS, Steadiness
from devrf.calibration.field.sweep import ENOUGH, SweepGlance
from devrf.capture.session import Rest
from devrf.capture.stillness import AT_REST
from devrf.pipelines.health.rows import HealthRow, note, row

LISTED = 4  # places named in a message
LINKED_WARN, LINKED_FAIL = 0.95, 0.5
DEPTH_WARN, DEPTH_FAIL = 0.1, 0.04  # real sweeps: 0.24 to 0.58; pictures of a camera that only turned: 0.02
SWEEP_STOPS = (
    0.5  # neighbours' errors add up along the sweep, and surfaces shine; automatic exposure moves by stops
)
SWEEP_BALANCE = 0.25
FIXED_STOPS, FIXED_BALANCE = 0.1, 0.03
SUBJECT_WARN = 0.002  # of the picture in which something moves: 0.002 are 25 x 25 of 640 x 480 pixels
SHARED_WARN, SHARED_FAIL = 100.0, 12.0  # features; stage rig finds about as many points, and refuses below 30
AGREES = 0.85  # of the subject's matches, against those beside it


def sweep_rows(glance: SweepGlance, steady: Steadiness, black: bool, where: Sequence[str]) -> list[HealthRow]:
    """Rows about a sweep; `where` names its pictures."""
    if black:
        return [_black("the sweep")]
    breaks = [f"{where[n]} to {where[n + 1]}" for n in glance.breaks]
    more = " ..." if len(breaks) > LISTED else ""
    light = glance.light_stops[np.isfinite(glance.light_stops).all(axis=1)]
    against_green = light[:, [0, 2]] - light[:, 1:2]
    return [
        _walks(steady),
        row(
            "neighbouring pictures of the sweep that overlap",
            glance.linked,
            "",
            warn=LINKED_WARN,
            fail=LINKED_FAIL,
            remedy=f"Fewer than {ENOUGH} matches from {', '.join(breaks[:LISTED])}{more}: walk there again, slowly, "
            "looking at the same things; blank walls need something textured (posters, newspapers, rugs).",
        ),
        row(
            "matches of the sweep that show depth",
            glance.depth_share,
            "",
            warn=DEPTH_WARN,
            fail=DEPTH_FAIL,
            remedy="The camera turned but did not move, or it only sees something flat: walk sideways around the "
            "scene, and let things at different distances be in view.",
        ),
        note(
            "end of the sweep",
            "sees what its start saw"
            if glance.closes
            else "does not see what its start saw; going on until it does would hold the whole together",
        ),
        row(
            "change of exposure over the sweep",
            float(np.ptp(light[:, 1])) if len(light) > 1 else None,
            "stops",
            warn=SWEEP_STOPS,
            low_is_bad=False,
            remedy="Lock the exposure (and the ISO) before the sweep.",
        ),
        row(
            "change of white balance over the sweep",
            float(2 ** np.ptp(against_green, axis=0).max() - 1) if len(light) > 1 else None,
            "",
            warn=SWEEP_BALANCE,
            low_is_bad=False,
            remedy="Lock the white balance before the sweep.",
        ),
    ]


def camera_rows(
    name: str, glance: FixedGlance, steady: Steadiness, black: bool, rest: Rest, *, has_sweep: bool
) -> list[HealthRow]:
    """Rows about one fixed camera; what is at rest is compared with a sweep."""
    if black:
        return [_black(name)]
    rows = [_stands(name, steady)]
    rows.append(
        row(
            f"share of {name}'s picture in which something moves",
            glance.subject_share,
            "",
            warn=SUBJECT_WARN,
            remedy=f"{name} does not see the subject: point it there, go nearer.",
        )
    )
    if steady.stands is not False:
        rows += _light(name, glance)
        if has_sweep and rest != "none":
            rows += _rest(name, glance, rest)
    if has_sweep:
        rows.append(
            row(
                f"features that {name} shares with the sweep",
                None if glance.shared is None else float(glance.shared),
                "",
                warn=SHARED_WARN,
                fail=SHARED_FAIL,
                remedy=f"Film sweep pictures from near {name}, looking the same way; match exposure and colour.",
            )
        )
    return rows


def _black(name: str) -> HealthRow:
    return note(
        f"picture of {name}",
        "black",
        verdict="fail",
        remedy="Nothing was filmed: take the lens cap off, make light.",
    )


def _walks(steady: Steadiness) -> HealthRow:
    check = "movement of the sweep's camera"
    if steady.stands:
        remedy = "Walk around the scene with the camera; pictures from one place show no depth."
        return note(check, "its background stands still", verdict="fail", remedy=remedy)
    return note(check, "too little texture to tell" if steady.stands is None else "moves")


def _stands(name: str, steady: Steadiness) -> HealthRow:
    check = f"movement of {name} while it filmed"
    if steady.stands is None:
        return note(check, "too little texture to tell", verdict="ok")
    if np.isnan(steady.moved):
        remedy = f"{name} moves: put it on a tripod, switch stabilisation off, film again."
        return note(check, "its background is never found again", verdict="fail", remedy=remedy)
    return row(
        check,
        100 * steady.moved,
        "% of the width",
        warn=0.3,
        fail=100 * STANDS,
        low_is_bad=False,
        remedy=f"{name} moves: put it on a tripod, switch stabilisation off, film again.",
    )


def _light(name: str, glance: FixedGlance) -> list[HealthRow]:
    rows = []
    for check, value, unit, warn, lock in (
        ("exposure", glance.light_stops, "stops", FIXED_STOPS, "exposure and gain"),
        ("white balance", glance.balance, "", FIXED_BALANCE, "white balance"),
    ):
        if np.isfinite(value):
            remedy = f"Lock {lock} of {name}, and film again if you can."
            rows.append(
                row(f"change of {check} of {name}", value, unit, warn=warn, low_is_bad=False, remedy=remedy)
            )
    return rows


def _rest(name: str, glance: FixedGlance, rest: Rest) -> list[HealthRow]:
    rows = [
        row(
            f"share of {name}'s picture that moves at the {rest}",
            glance.rest_share,
            "",
            warn=AT_REST,
            low_is_bad=False,
            remedy=f"The scene is not at rest at the {rest} of {name}'s clip: start the cameras before the action, or "
            "set capture.rest to when it is.",
        )
    ]
    if glance.subject_agrees is not None and glance.rest_agrees:
        rows.append(
            row(
                f"subject at the {rest} of {name}'s clip against the sweep",
                glance.subject_agrees / glance.rest_agrees,
                "of what agrees beside it",
                warn=AGREES,
                remedy=f"What will move is not where the sweep saw it: put it back as it was, or film the sweep again, "
                f"and let the clips {rest} with the scene so.",
            )
        )
    return rows
