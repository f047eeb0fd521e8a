"""Rows about the disk and the memory that a run may use."""

from pathlib import Path

from devrf.capture.amounts import GB, size_text
from devrf.pipelines.budget.disk import room_of
from devrf.pipelines.budget.memory import allowed_bytes
from devrf.pipelines.config.scene import SceneConfig
from devrf.pipelines.health.rows import HealthRow, note, row


def resource_rows(config: SceneConfig, scene_dir: Path, run_dir: Path) -> list[HealthRow]:
    """What a run may use. How much it will need is not known before."""
    room = room_of(config, scene_dir, run_dir)
    return [
        row(
            "room for the run folder",
            room.count / GB,
            f"GB, because {room.bound}",
            fail=0.0,
            remedy=f"{room.remedy[0].upper()}{room.remedy[1:]}.",
        ),
        note("main memory that a run may use", size_text(allowed_bytes(config))),
    ]
