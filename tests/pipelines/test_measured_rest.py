"""The time of rest that stage `scene` finds in pictures, by what scene.yaml says, and what its row says."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from tests.calibration import coloured_room as room

from devrf.calibration.extent.motion_masks import MotionMask
from devrf.calibration.sweep.static_poses import SweepModel
from devrf.capture.photos.picture_files import write_png
from devrf.capture.rest import Rest
from devrf.capture.scene import PosedFrame
from devrf.pipelines.health.judge import HealthRow, judge
from devrf.pipelines.stages.scene.measured_rest import rest_time

COLUMNS = slice(140, 340)  # of the picture, in which something moves
ALWAYS = (0.0, 1.0)  # both cameras film
FROM_START = (0, 20, 40, 50, 60, 70, 80)  # pixels by which it has moved
NEVER = (10, 20, 40, 50, 60, 70, 80)


@dataclass(frozen=True)
class Filmed:
    """A sweep of the room, and the pictures of two fixed cameras, in a folder."""

    folder: Path
    model: SweepModel
    masks: dict[str, MotionMask]

    def clips(self, moved_px: tuple[int, ...]) -> dict[str, list[PosedFrame]]:
        """What the cameras film while the middle of their pictures has moved by so many pixels."""
        return {
            name: [
                PosedFrame(self.folder / f"{name}_{px}.png", mask.camera, name, n, n / 10, n / 6, "train")
                for n, px in enumerate(moved_px)
            ]
            for name, mask in self.masks.items()
        }

    def rest(self, asked: Rest, moved_px: tuple[int, ...] = FROM_START) -> tuple[float | None, HealthRow]:
        """The time, and the row."""
        clips = self.clips(moved_px)
        time, seen = rest_time(asked, clips, self.masks, ALWAYS, (self.model, 1.0), self.folder)
        (row,) = judge(seen)
        return time, row


@pytest.fixture(scope="module")
def filmed(tmp_path_factory: pytest.TempPathFactory) -> Filmed:
    folder, model, masks = tmp_path_factory.mktemp("ingest"), room.sweep(5, 300), {}
    (folder / "frames" / "static").mkdir(parents=True)
    for n, (name, camera) in enumerate(zip(model.names, model.cameras, strict=True)):
        write_png(folder / "frames" / name, room.show(camera, seed=n).rgb)
    for name, angle in (("cam0", 0.7), ("cam1", 0.9)):
        view = room.show(room.camera(angle, -1.2), seed=99)
        moves = np.zeros(view.rgb.shape[:2], bool)
        moves[:, COLUMNS] = True
        masks[name] = MotionMask(view.camera, moves)
        for px in {*FROM_START, *NEVER}:
            moved = view.rgb.copy()
            moved[:, COLUMNS] = np.roll(view.rgb, px, axis=0)[:, COLUMNS]
            write_png(folder / f"{name}_{px}.png", moved)
    return Filmed(folder, model, masks)


@pytest.mark.parametrize(
    ("asked", "time", "against", "verdict"),
    [
        ("auto", 0.0, "", "ok"),
        ("start", 0.0, "", "ok"),
        ("end", 1.0, "capture.rest says end", "warn"),
        ("none", None, "capture.rest says none", "ok"),
    ],
)
def test_a_rest_at_the_start(
    filmed: Filmed, asked: Rest, time: float | None, against: str, verdict: str
) -> None:
    found, row = filmed.rest(asked)
    assert found == time and row.code == "rest-unseen" and row.verdict == verdict
    said = str(row.value).split(";")[0]
    assert "at the start" in said and ("capture.rest" in said) == bool(against) and against in said
    assert "cam0 recognises" in str(row.value) and "cam1 recognises" in str(row.value)
    assert bool(row.remedy) == (verdict == "warn")


def test_a_middle_that_nobody_sees_is_doubted(filmed: Filmed) -> None:
    found, row = filmed.rest("middle")
    assert found is not None and 0 < found < 1
    assert row.verdict == "warn" and "capture.rest says middle" in str(row.value)


def test_a_rest_at_the_end(filmed: Filmed) -> None:
    found, row = filmed.rest("auto", FROM_START[::-1])
    assert found == 1.0 and row.verdict == "ok" and "at the end" in str(row.value)


@pytest.mark.parametrize("asked", ["auto", "middle"])
def test_a_rest_between(filmed: Filmed, asked: Rest) -> None:
    found, row = filmed.rest(asked, (20, 40, 0, 40, 60, 70, 80))
    assert found == pytest.approx(2 / 6) and row.verdict == "ok" and "at the middle" in str(row.value)


@pytest.mark.parametrize(
    ("asked", "time", "verdict"), [("auto", None, "warn"), ("start", 0.0, "warn"), ("none", None, "ok")]
)
def test_clips_without_a_rest(filmed: Filmed, asked: Rest, time: float | None, verdict: str) -> None:
    found, row = filmed.rest(asked, NEVER)
    assert found == time and row.verdict == verdict and "at no moment" in str(row.value)
    assert ("capture.rest says start" in str(row.value)) == (asked == "start")


@pytest.mark.parametrize(
    ("asked", "shared", "time"),
    [
        ("auto", ALWAYS, 0.0),
        ("start", (0.1, 0.9), 0.1),
        ("end", (0.1, 0.9), 0.9),
        ("middle", ALWAYS, 0.5),
        ("none", ALWAYS, None),
        # a camera that films only later, or only before, does not see the rest
        ("start", (0.5, 1.0), 0.0),
        ("end", (0.0, 0.5), 1.0),
    ],
)
def test_without_a_sweep_the_word_of_the_configuration_holds(
    filmed: Filmed, asked: Rest, shared: tuple[float, float], time: float | None
) -> None:
    clips = filmed.clips(FROM_START)
    assert rest_time(asked, clips, filmed.masks, shared, None, filmed.folder) == (time, [])
