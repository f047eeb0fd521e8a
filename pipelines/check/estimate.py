"""How much disk and time a run will take, from what was measured; rough, and said to be."""

import math
import tempfile
from collections.abc import Mapping
from pathlib import Path

from devrf.capture.frames import SWEEP, CameraFrames
from devrf.capture.pictures import list_pictures, write_picture
from devrf.capture.survey import Look, Picture
from devrf.pipelines.config.scene import SceneConfig
from devrf.pipelines.console import duration
from devrf.pipelines.health.rows import HealthRow, row

FLOW_BYTES = 2.5  # per pixel of a moving picture: the bound that stage flow keeps
MODELS_GB = 0.1  # models, films, report: the example's are 0.03
GB = 1e9

# Measured on the example session (72 sweep pictures, five cameras with 43 pictures each, 480x360) on two CPU cores
# beside other jobs; other sessions and machines differ by a factor of `UNSURE` or more.
INGEST_S_PER_MEGAPIXEL = 0.1
MATCHING_S_PER_PAIR = 0.02  # of sweep pictures, every one with every other
RIG_S_PER_CAMERA = 4.0
FLOW_S_PER_MEGAPIXEL = 0.45
TRAINING_S: dict[str, float] = {
    "tiny": 620.0,
    "fast": 2500.0,
}  # with evaluation and film; reference was never measured
MOTION_S: dict[str, float] = {"tiny": 130.0, "fast": 1140.0}  # of them: stage deformation, not at rest
UNSURE = 3


def estimate_rows(
    config: SceneConfig,
    run_dir: Path,
    planned: Mapping[str, CameraFrames],
    looks: Mapping[str, Look],
    free_bytes: int,
) -> list[HealthRow]:
    """Rows about room on the disk and about time."""
    need_gb = disk_gb(planned, looks)
    budget = config.budget.disk_gb
    room_gb = min(free_bytes / GB, math.inf if budget is None else budget)
    what = "free" if budget is None or free_bytes / GB < budget else "allowed (budget.disk_gb)"
    rows = [
        row(
            f"room for the run folder, which needs about {need_gb:.2g} GB",
            room_gb,
            f"GB {what}",
            warn=2 * need_gb,
            fail=need_gb,
            remedy=f"Make room where {run_dir} lies, or set output to another disk.",
        )
    ]
    return rows + time_rows(config, planned)


def disk_gb(planned: Mapping[str, CameraFrames], looks: Mapping[str, Look]) -> float:
    """Pictures as ingest stores them, by one of each clip; flow by its bound."""
    total = 0.0
    for name, frames in planned.items():
        look, count = looks[name], len(frames.used)
        pixels = frames.width * frames.height
        if look.is_clip and look.pictures:
            picture = look.pictures[len(look.pictures) // 2]
            total += count * _stored_bytes(picture) * pixels / (picture.shape[0] * picture.shape[1])
        else:
            total += sum(photo.stat().st_size for photo in list_pictures(look.path))
        if name != SWEEP:
            total += FLOW_BYTES * count * pixels
    return total / GB + MODELS_GB


def time_rows(config: SceneConfig, planned: Mapping[str, CameraFrames]) -> list[HealthRow]:
    """How long a run takes without a GPU, against the budget."""
    seconds = calibration_seconds(config, planned)
    at_rest = config.kind == "sweep"
    words = f"{duration(seconds)} to {'the places of the pictures' if at_rest else 'optical flow'}"
    if config.kind == "cameras":
        words += ", where it ends without a sweep"
    elif config.preset in TRAINING_S:
        training_s = TRAINING_S[config.preset] - (MOTION_S[config.preset] if at_rest else 0.0)
        seconds += training_s
        words += f", {duration(training_s)} to train, measure and film"
    else:
        words += f", and training, which was not measured with {config.preset}"
    return [
        row(
            f"time of a run on two CPU cores, to a factor of {UNSURE} ({words})",
            seconds / 60,
            "min",
            warn=config.budget.time_minutes,
            low_is_bad=False,
            remedy="Use a faster preset or a GPU, or give it more time (budget.time_minutes).",
        )
    ]


def calibration_seconds(config: SceneConfig, planned: Mapping[str, CameraFrames]) -> float:
    """From raw files to optical flow."""
    megapixels = {n: len(f.used) * f.width * f.height / 1e6 for n, f in planned.items()}
    moving = {n: m for n, m in megapixels.items() if n != SWEEP}
    pictures = len(planned[SWEEP].used) if SWEEP in planned else 0
    limit = config.calibration.static_poses.time_minutes
    matching_s = MATCHING_S_PER_PAIR * pictures * (pictures - 1) / 2
    return (
        INGEST_S_PER_MEGAPIXEL * sum(megapixels.values())
        + min(matching_s, math.inf if limit is None else 60 * limit)
        + RIG_S_PER_CAMERA * len(moving)
        + FLOW_S_PER_MEGAPIXEL * sum(moving.values())
    )


def _stored_bytes(picture: Picture) -> int:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "0.jpg"
        write_picture(path, picture)
        return path.stat().st_size
