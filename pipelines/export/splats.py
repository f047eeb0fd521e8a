"""What the exports of splats share: how many, and how they are made."""

from typing import TYPE_CHECKING

from devrf.capture.errors import InputError
from devrf.capture.progress import Progress
from devrf.pipelines.export.request import Request
from devrf.pipelines.export.trained import Trained

if TYPE_CHECKING:  # it needs torch
    from devrf.reconstruct.splats.make import Splats

COUNT = 30_000  # about what software WebGL plays 20 times a second (docs/player.md)
FEWEST, MOST = 500, 2_000_000


def asked(request: Request) -> int:
    """`--splats`, or the usual number.

    Raises:
        InputError: Too few or too many.
    """
    count = COUNT if request.options.splats is None else request.options.splats
    if not FEWEST <= count <= MOST:
        text = f"--splats {count}: expected {FEWEST} to {MOST}; {COUNT} if it is left out"
        raise InputError("option-out-of-range", text)
    return count


def made(trained: Trained, count: int, progress: Progress) -> "Splats":
    """Splats of the model at the times that were asked for."""
    from devrf.reconstruct.splats.make import make_splats

    times = [moment.time for moment in trained.moments]
    return make_splats(trained.boxed, trained.model, count, times, progress)
