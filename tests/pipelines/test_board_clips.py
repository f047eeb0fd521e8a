"""Board clips are searched once, whoever asks for them, and refused where they are not in the camera's mode."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from tests.refused import refused

from devrf.calibration.boards.find import BoardSpec, BoardView
from devrf.capture.frames import CameraFrames, FrameRecord, FrameSet
from devrf.capture.orientation import Upright
from devrf.capture.photos.extract import extract_folder
from devrf.capture.photos.upright_pictures import read_picture
from devrf.capture.system.errors import HealthError, InputError
from devrf.lab.bench.accuracy.simulated_boards import SIZE, SPEC, board_views
from devrf.pipelines.inputs import board_clips
from devrf.pipelines.inputs.board_clips import BoardClips
from devrf.pipelines.stages.rig.joint_clips import read_joint_views
from devrf.pipelines.stages.rig.rig_job import RigJob

TOLD = replace(SPEC, legacy="auto", inverted="auto")
SETTLED = replace(SPEC, legacy=False, inverted=False)
VIEWS = 12


def clip(role: str, source: str, size: tuple[int, int] = SIZE) -> CameraFrames:
    frames = tuple(FrameRecord(n, n / 30, 1.0, True, f"{source}/{n}.png") for n in range(VIEWS))
    return CameraFrames(role, source, *size, 30.0, False, False, None, 0, frames)  # type: ignore[arg-type]


@pytest.fixture
def frames() -> FrameSet:
    """cam0 has a clip of its own and a joint one, cam1 a joint one only."""
    cameras = {n: clip("camera", f"{n}.mp4") for n in ("cam0", "cam1")}
    cameras |= {"board_cam0": clip("board", "own0.mp4")}
    cameras |= {f"joint_{n}": clip("joint", f"joint_{n}.mp4") for n in ("cam0", "cam1")}
    return FrameSet(cameras, {n: f"joint_{n}" for n in ("cam0", "cam1")})


@pytest.fixture
def searched(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Clips in the order in which they are searched; each shows the board."""
    names: list[str] = []

    def find(
        name: str, files: list[Path], spec: BoardSpec, progress: Callable, required: bool
    ) -> tuple[list[BoardView], BoardSpec]:
        names.append(files[0].parent.name)
        return board_views(VIEWS, 0.1, seed=len(names)), SETTLED

    monkeypatch.setattr(board_clips, "find_board", find)
    return names


def test_both_routes_together_search_each_clip_once(
    frames: FrameSet, searched: list[str], tmp_path: Path
) -> None:
    job = object.__new__(RigJob)
    job.frames, job.boards = frames, {}
    job.clips = BoardClips(tmp_path, frames, TOLD)
    known = job.clip_calibrations(frames.trained, lambda fraction, message: None)
    assert searched == ["own0.mp4", "joint_cam1.mp4"]
    seen = read_joint_views(job.clips, ["cam0", "cam1"], {"cam0": known["cam0"]})
    assert searched == ["own0.mp4", "joint_cam1.mp4", "joint_cam0.mp4"]
    assert seen.own["cam1"] is job.boards["cam1"]  # nor is it fitted twice
    assert seen.spec == SETTLED and [len(v) for v in seen.views.values()] == [VIEWS, VIEWS]


def test_another_print_is_searched_again(frames: FrameSet, searched: list[str], tmp_path: Path) -> None:
    """Where the clip before was settled otherwise; what only the description had wrong is no other print."""
    clips = BoardClips(tmp_path, frames, TOLD)
    first = clips.search("cam0", "joint_cam0")
    corrected = replace(SETTLED, corrections=(("squares", "[8, 6]"),))
    assert clips.search("cam0", "joint_cam0", corrected) is first and len(searched) == 1
    assert clips.search("cam0", "joint_cam0", replace(SETTLED, legacy=True)) is not first
    assert len(searched) == 2


def test_a_clip_without_the_board_is_refused_once_it_is_needed(
    frames: FrameSet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def find(name: str, files: list[Path], spec: BoardSpec, progress: Callable, required: bool) -> tuple:
        if required:
            raise HealthError("board-never-seen", f"board never seen in {name}")
        return [], spec

    monkeypatch.setattr(board_clips, "find_board", find)
    clips = BoardClips(tmp_path, frames, TOLD)
    assert clips.search("cam1", "joint_cam1", required=False).views == []
    with refused("board-never-seen", "joint_cam1.mp4", "'cam1'", kind=HealthError):
        clips.search("cam1", "joint_cam1")


@pytest.mark.parametrize("entry", ["board_cam0", "joint_cam0"])
def test_a_clip_in_another_mode_is_refused_before_it_is_searched(
    frames: FrameSet, searched: list[str], tmp_path: Path, entry: str
) -> None:
    small = replace(frames.cameras[entry], width=640, height=360)
    other = replace(frames, cameras=frames.cameras | {entry: small})
    with refused("board-clip-size", "640x360", "'cam0'", "1280x720", kind=InputError):
        BoardClips(tmp_path, other, TOLD).search("cam0", entry)
    assert searched == []


@pytest.mark.parametrize(
    ("turn_deg", "size"), [(180, SIZE), (90, SIZE[::-1]), (270, SIZE[::-1])], ids=["upside", "left", "right"]
)
def test_a_camera_held_otherwise_before_the_board_has_the_lens_of_its_other_clips(
    frames: FrameSet, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, turn_deg: int, size: tuple[int, int]
) -> None:
    turn = Upright(turn_deg // 90)
    seen = board_views(VIEWS, 0.1)
    shown = [replace(view, xy=turn.points(view.xy, *SIZE)) for view in seen]
    monkeypatch.setattr(board_clips, "find_board", lambda *args: (shown, SETTLED))
    own = replace(frames.cameras["board_cam0"], width=size[0], height=size[1], rotation_deg=turn_deg)
    turned = replace(frames, cameras=frames.cameras | {"board_cam0": own})
    found = BoardClips(tmp_path, turned, TOLD).search("cam0", "board_cam0")
    assert found.size == SIZE
    for view, true in zip(found.views, seen, strict=True):
        np.testing.assert_allclose(view.xy, true.xy)


def test_a_clip_that_is_turned_and_does_not_say_how_is_refused_as_that(
    frames: FrameSet, searched: list[str], tmp_path: Path
) -> None:
    tall = replace(frames.cameras["board_cam0"], width=SIZE[1], height=SIZE[0])
    other = replace(frames, cameras=frames.cameras | {"board_cam0": tall})
    with refused("board-clip-size", "720x1280", "turned", "held", kind=InputError):
        BoardClips(tmp_path, other, TOLD).search("cam0", "board_cam0")


@pytest.mark.parametrize(("asked", "turned_deg"), [((3,) * 6, 180), ((6,) * 6, 270), ((1, 1, 1, 1, 3, 6), 0)])
def test_photos_of_a_board_are_turned_to_the_pictures_of_its_camera(
    frames: FrameSet, tmp_path: Path, asked: tuple[int, ...], turned_deg: int
) -> None:
    """Whatever turn photos of the board ask for, each is laid over the camera's clip as both are stored."""
    (tmp_path / "board").mkdir()
    cells = np.random.default_rng(0).integers(40, 200, (6, 3, 4, 3))
    pictures = np.kron(cells, np.ones((1, 16, 16, 1))).astype(np.uint8)
    for n, (picture, turn) in enumerate(zip(pictures, asked, strict=True)):
        exif = Image.Exif()
        exif[0x0112] = turn
        Image.fromarray(picture).save(tmp_path / "board" / f"{n}.png", exif=exif)
    photos = extract_folder(tmp_path / "board", tmp_path, "board_cam0", "board", "board")
    assert len(photos.used) == 6 and photos.rotation_deg == turned_deg
    turn = board_clips.turn_between(photos, replace(frames.cameras["cam0"], width=64, height=48))
    assert turn is not None
    for frame, picture in zip(photos.used, pictures, strict=True):
        np.testing.assert_array_equal(turn.apply(read_picture(tmp_path / str(frame.file))), picture)
