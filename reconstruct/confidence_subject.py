"""How well the subject is known from every direction that the sweep looked from.

The model is rendered, small, from a few places of the sweep at a few times, as nobody may have filmed it. The subject
is what moves, or all that is solid in the box where nothing does.
"""

from typing import Any

import numpy as np

from devrf.capture.scene import Scene
from devrf.reconstruct.confidence import Confidence, witness_camera
from devrf.reconstruct.model import SOLID
from devrf.reconstruct.pictures import spread, training

DIRECTIONS = 4  # of the sweep
TIMES = (1 / 3, 2 / 3)  # of the clip, where something moves
LEAST_MOVING = 0.02  # of the points, to be the subject: the box is made around what moves, less is stray
LOW_DB = 18.0  # expected PSNR, below which test views are doubted, too
GREY = 255.0


def subject_confidence(scene: Scene, confidence: Confidence) -> dict[str, Any]:
    """Shares of the subject's pixels.

    Args:
        scene: In any frame.
        confidence: Of the model.
    Returns:
        `moves`: whether only what moves was taken; `low_above`: grey levels that count as low confidence; `low_share`
        (None where nothing solid is seen); `unseen_share`: what no moving camera sees at that time (None where not only
        what moves was taken); `seen_by`: by number of `cameras` that see it (moving ones, or witnesses of the sweep),
        `share` and `expected_rms`, grey levels.
    """
    scene = scene.in_box_frame()
    times = TIMES if confidence.fixed else (None,)
    parts = []
    for frame in spread(training(scene.static), DIRECTIONS):
        camera, _ = witness_camera(frame, scene.image_scale)
        for time in times:
            seen = confidence.seen(camera, time, confidence.render(camera, time))
            columns = seen.expected, seen.in_sweep, seen.in_motion, seen.moves
            parts.append([column[seen.opacity > SOLID] for column in columns])
    expected, in_sweep, in_motion, moving = (np.concatenate(c) for c in zip(*parts, strict=True))
    moves = len(moving) > 0 and bool(moving.mean() >= LEAST_MOVING)
    kept = moving if moves else np.ones(len(moving), bool)
    expected, cameras = expected[kept], (in_motion if moves else in_sweep)[kept]
    low = 10 ** (-LOW_DB / 10)
    return {
        "moves": moves,
        "low_above": GREY * low**0.5,
        "low_share": float((expected > low).mean()) if len(expected) else None,
        "unseen_share": float((cameras == 0).mean()) if moves else None,
        "seen_by": [
            {
                "cameras": int(n),
                "share": float((cameras == n).mean()),
                "expected_rms": GREY * float(np.sqrt(expected[cameras == n].mean())),
            }
            for n in np.unique(cameras)
        ],
    }
