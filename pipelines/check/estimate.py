"""Rows about room, memory and time for a run, from a look at the clips; the numbers are those of `pipelines/budget`."""

import math
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from devrf.capture.amounts import GB
from devrf.capture.pictures import write_picture
from devrf.capture.survey import Look, Picture
from devrf.pipelines.budget.disk import Room
from devrf.pipelines.budget.estimate import UNSURE, stage_needs
from devrf.pipelines.budget.forecast import Forecast, forecast_of
from devrf.pipelines.budget.material import Material, Source, planned_material
from devrf.pipelines.budget.need import Need
from devrf.pipelines.config.scene import SceneConfig
from devrf.pipelines.console import duration
from devrf.pipelines.health.rows import HealthRow, Verdict, row

TRAINING = ("canonical", "deformation", "evaluate", "render", "report")


def estimate_rows(
    config: SceneConfig,
    run_dir: Path,
    material: Material,
    rooms: Sequence[Room],
    allowed: int,
    device: str,
) -> list[HealthRow]:
    """Rows about room on the disk, main memory and time.

    Args:
        config: The configuration.
        run_dir: The run folder.
        material: What a run works on.
        rooms: All of which it has to keep within.
        allowed: Main memory that may be used, bytes.
        device: What a run would train on, cpu or cuda.
    """
    needs = stage_needs(config, material, device)
    found = forecast_of(needs, config, material, device, allowed, rooms, run_dir)
    need_gb = found.disk / GB
    return [
        row(
            f"room for the run folder, which needs about {need_gb:.2g} GB",
            found.room.count / GB,
            f"GB, because {found.room.bound}",
            warn=2 * need_gb,
            fail=need_gb,
            remedy=f"{found.room.remedy[0].upper()}{found.room.remedy[1:]}.",
        ),
        _memory_row(found),
        time_row(config, list((needs if device == "cpu" else stage_needs(config, material)).values())),
    ]


def seen_material(config: SceneConfig, sources: Mapping[str, Source], looks: Mapping[str, Look]) -> Material:
    """What a run of a capture works on.

    Args:
        config: The configuration.
        sources: What its clips' headers say.
        looks: Those that were looked into: their own pictures tell how large stored ones will be.
    """
    seen = {
        name: source if name not in looks else replace(source, bytes_each=_stored_bytes(source, looks[name]))
        for name, source in sources.items()
    }
    return planned_material(config, seen)


def _memory_row(found: Forecast) -> HealthRow:
    """What `run` would refuse for its memory is a no-go; what it would doubt, or train coarser, a warning."""
    largest = max(found.needs, key=lambda need: need.least)
    coarser = [f"{fit.need.stage}: {line}" for fit in found.fits for line in fit.decided]
    verdict: Verdict = "fail" if found.too_large else "warn" if found.doubtful or coarser else "ok"
    return HealthRow(
        f"main memory, of which {largest.stage} needs about {largest.least / GB:.2g} GB",
        found.allowed / GB,
        "GB allowed",
        None,
        None,
        verdict,
        "; ".join([*found.too_large, *found.doubtful, *coarser]),
    )


def time_row(config: SceneConfig, needs: Sequence[Need]) -> HealthRow:
    """How long a run takes without a GPU, against the budget."""
    early = sum(need.seconds or 0.0 for need in needs if need.stage not in TRAINING)
    late = [need.seconds for need in needs if need.stage in TRAINING]
    at_rest = config.kind == "sweep"
    words = f"{duration(early)} to {'the places of the pictures' if at_rest else 'optical flow'}"
    seconds = early
    if not late:
        words += ", where it ends without a sweep"
    elif None not in late:
        training_s = sum(s for s in late if s is not None)
        seconds += training_s
        words += f", {duration(training_s)} to train, measure and film"
    else:
        words += f", and training, which was not measured with {config.preset}"
    return row(
        f"time of a run on two CPU cores, to a factor of {UNSURE} ({words})",
        seconds / 60,
        "min",
        warn=config.budget.time_minutes,
        low_is_bad=False,
        remedy="Use a faster preset or a GPU, or give it more time (budget.time_minutes).",
    )


def _stored_bytes(source: Source, look: Look) -> float:
    """Of a picture as ingest stores it, by one that was looked at."""
    if not look.pictures or source.kind != "clip":
        return source.bytes_each
    picture: Picture = look.pictures[len(look.pictures) // 2]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "0.jpg"
        write_picture(path, picture)
        return path.stat().st_size * source.pixels / math.prod(picture.shape[:2])
