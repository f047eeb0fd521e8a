"""Health rows about the scene at rest as the fixed cameras see it: asked before motion is learned from them."""

from collections.abc import Mapping, Sequence
from math import inf, isinf
from statistics import median

from devrf.pipelines.health.rows import HealthRow, row
from devrf.reconstruct.check_rest import RestFit

# A picture may lie so far beside the model: two cameras then disagree by a voxel, which reads as motion.
MOST_VOXELS = 0.5
SURE = 2.0  # standard deviations beyond that
WORSE_DB = 3.0  # than the sweep's held-out pictures: half of the camera's error is not the model's


def at_rest_rows(cameras: Mapping[str, RestFit], sweep: Sequence[RestFit]) -> list[HealthRow]:
    """Rows about the worst camera; none where nothing can be told.

    Args:
        cameras: What each fixed camera sees.
        sweep: The same of held-out pictures of the sweep, which say how well the model fits pictures that are right.
    """
    return [*_beside(cameras, sweep), *_unlike(cameras, sweep)]


def _beside(cameras: Mapping[str, RestFit], sweep: Sequence[RestFit]) -> list[HealthRow]:
    usual = [
        fit.displaced.length if fit.displaced.found else inf for fit in sweep if fit.displaced is not None
    ]
    of_sweep = median(usual) if usual else 0.0
    if isinf(of_sweep):  # the sweep's own pictures are not found again: nothing can be told by that
        return []
    found = {
        name: (fit.displaced.length, max(MOST_VOXELS * fit.voxel, of_sweep) + SURE * fit.displaced.std)
        for name, fit in cameras.items()
        if fit.displaced is not None
    }
    if not found:
        return []
    name = max(found, key=lambda n: found[n][0] / found[n][1])
    length, most = found[name]
    return [
        row(
            f"picture beside the scene at rest, worst camera ({name})",
            100 * length,
            "% of its width",
            warn_above=100 * most,
            remedy=f"{name} does not stand where the rig says, or has another focal length: leave tripod and zoom as "
            "they are between board, sweep and clip, film the board with this zoom (capture.board.clips), and let the "
            "sweep show what this camera sees.",
        )
    ]


def _unlike(cameras: Mapping[str, RestFit], sweep: Sequence[RestFit]) -> list[HealthRow]:
    right = [fit.psnr for fit in sweep if fit.psnr is not None]
    found = {name: fit.psnr for name, fit in cameras.items() if fit.psnr is not None}
    if len(right) < 2 or not found:
        return []
    name = min(found, key=lambda n: found[n])
    return [
        row(
            f"PSNR of the scene at rest, worst camera ({name})",
            found[name],
            "dB",
            warn=min(min(right), median(right) - WORSE_DB),
            remedy=f"{name} does not show what the sweep shows: let its clip begin with the scene as in the sweep "
            "(capture.rest), with the same light, exposure and white balance, keep people and shadows out, and check "
            "its pose in the report.",
        )
    ]
