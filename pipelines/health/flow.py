"""Health rows of the flow: what its own checks say, and what the crew can do about it."""

from collections.abc import Callable

from devrf.flow.checks import FlowChecks
from devrf.pipelines.health.rows import HealthRow, note, row

SHAKE_PX = 0.1  # a tenth of a pixel is what flow itself is unsure of, in the median of a corner
RATHER = {
    "forward": ("the flow leads to the next frame, not to the one before", "turn the direction round"),
    "next": ("the flow of a frame is that of the frame after it", "shift its files by one"),
    "before": ("the flow of a frame is that of the frame before it", "shift its files by one"),
    "full size": ("vectors are in pixels of the full-size picture", "scale them by the ratio of the sizes"),
}
"""Other explanations of a flow (`FlowChecks.better_as`): what it says, and what to do."""


def health(checks: dict[str, FlowChecks], given: bool = False) -> list[HealthRow]:
    """Rows for the worst camera of each check (docs: capture, hand-off to training).

    Given flow need not be consistent with a way back that nobody knows; its mask may leave out the backdrop.
    """
    if not checks:
        return [note("flow", "no training camera sees the scene move: no flow")]
    rows = [] if given else [_consistent(checks)]
    moving = {name: check for name, check in checks.items() if check.moving_valid is not None}
    rows += _of_motion(moving, given) if moving else [_nothing_moves()]
    rows += _of_cameras(checks)
    gaps = {name: check.gaps for name, check in checks.items() if check.gaps}
    if gaps:
        total = sum(check.gaps + check.pairs for check in checks.values())
        text = ", ".join(f"{name}: {count}" for name, count in gaps.items())
        rows.append(
            note(
                "gaps in the clips",
                f"{text} (of {total} pairs); no flow across them",
                remedy="Frames were dropped while filming: use faster cards, or a lower resolution.",
            )
        )
    return rows


def _consistent(checks: dict[str, FlowChecks]) -> HealthRow:
    camera, value = _worst(checks, lambda check: check.valid, min)
    return row(
        f"consistent share of what can be followed, worst camera ({camera})",
        value,
        warn=0.7,
        fail=0.3,
        remedy="Most of the flow contradicts itself: film with a higher frame rate, a shorter shutter "
        "and more light; check that frames are in order.",
    )


def _nothing_moves() -> HealthRow:
    return note("motion", "nothing moves by more than half a pixel between frames")


def _of_motion(moving: dict[str, FlowChecks], given: bool) -> list[HealthRow]:
    """What is asked of clips in which something moves."""
    rows = []
    camera, value = _worst(moving, lambda check: check.moving_valid, min)
    rows.append(
        row(
            f"consistent share of what moves, worst camera ({camera})",
            value,
            warn=0.7,
            remedy="The motion is too fast, blurred or without texture, or much of it is hidden in the frame before: "
            "raise the frame rate or give the subject more texture.",
        )
    )
    camera, value = _worst(moving, lambda check: check.warp_ratio, max)
    rows.append(
        row(
            f"what warping leaves of the difference between frames, worst camera ({camera})",
            value,
            warn_above=0.8,
            fail_above=1.05,
            remedy="Following the flow does not lead to the previous frame: frames are out of order, or the "
            "light flickers; lock the exposure.",
        )
    )
    for camera, check in moving.items():
        if check.better_as is not None:
            says, remedy = RATHER[check.better_as]
            whose = "in the data set's flow" if given else "in the method's result (flow.method)"
            rows.append(
                note(f"what the flow is ({camera})", says, verdict="fail", remedy=f"{remedy} {whose}.")
            )
    camera, value = _worst(moving, lambda check: check.large, max)
    rows.append(
        row(
            f"share of moving pixels beyond 1/8 of the width, worst camera ({camera})",
            value,
            warn_above=0.05,
            remedy="The subject moves too far between frames for this flow: raise the frame rate, or set "
            "flow.method: raft."
            if not given
            else "The subject moves far between the data set's times: more times would help the motion.",
        )
    )
    camera, value = _worst(moving, lambda check: check.unsure, max)
    if not given:
        rows.append(
            row(
                f"share of what moves with too little texture to be followed, worst camera ({camera})",
                value,
                warn_above=0.4,
                remedy="Plain skin or cloth slides through unseen: give the subject texture (a pattern, make-up "
                "dots) or more light; its flow counts less.",
            )
        )
    return rows


def _of_cameras(checks: dict[str, FlowChecks]) -> list[HealthRow]:
    """What cameras and light do while they should do nothing; no row where it cannot be told."""
    rows = []
    lit = {name: check for name, check in checks.items() if check.brightness_step is not None}
    if lit:
        camera, value = _worst(lit, lambda check: check.brightness_step, max)
        rows.append(
            row(
                f"change of brightness from one frame to the next where nothing moves, worst camera ({camera})",
                100 * (value or 0.0),
                "%",
                warn_above=3.0,
                remedy="A change of brightness reads as motion: lock the exposure, and avoid lamps that flicker.",
            )
        )
    held = {name: check for name, check in checks.items() if check.shake_px is not None}
    if held:
        camera, value = _worst(held, lambda check: check.shake_px, max)
        rows.append(
            row(
                f"movement of the whole picture from frame to frame, worst camera ({camera})",
                value,
                "px",
                warn_above=SHAKE_PX,
                remedy="The fixed camera shakes: weigh the tripod down, keep away from it, and switch stabilisation "
                "off.",
            )
        )
    return rows


def _worst(
    checks: dict[str, FlowChecks], value: Callable[[FlowChecks], float | None], choose: Callable
) -> tuple[str, float | None]:
    """The camera with the worst value, and the value."""
    camera = choose(checks, key=lambda name: value(checks[name]) or 0.0)
    return camera, value(checks[camera])
