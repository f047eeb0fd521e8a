"""The pre-flight check: everything that is wrong with the raw files, at once."""

import shutil

import numpy as np
import pytest
from tests.refused import refused

from devrf.capture.photos.upright_pictures import probe_picture, write_picture
from devrf.capture.session import CaptureSession, preflight
from devrf.capture.system.errors import InputError
from devrf.capture.video.reader import probe_video
from devrf.capture.video.timestamps import check_table, read_timestamps

TABLE = "camera,frame_index,time_s\n"


def test_good_session_has_no_problems(make_clip, pictures, tmp_path):
    clip = make_clip("cam0.mp4", pictures)
    (tmp_path / "sweep").mkdir()
    for i in range(3):
        write_picture(tmp_path / "sweep" / f"p{i}.jpg", pictures[i])
    times = tmp_path / "t.csv"
    times.write_text(TABLE + "cam0,0,5.0\ncam0,1,5.1\n")
    session = CaptureSession(
        static=tmp_path / "sweep", cameras={"cam0": clip}, timestamps=times, joint_clips={"cam0": clip}
    )
    assert preflight(session) == []
    assert session.shares_joint_clip("cam0")
    assert [p.name for p in session.files()] == ["p0.jpg", "p1.jpg", "p2.jpg", "cam0.mp4", "t.csv"]


def test_a_copy_of_another_cameras_clip_is_no_camera(make_clip, pictures, tmp_path):
    clip = make_clip("cam0.mp4", pictures)
    copy = shutil.copy(clip, tmp_path / "witness.mp4")
    other = make_clip("cam1.mp4", pictures[::-1])
    session = CaptureSession(cameras={"cam0": clip, "cam1": other, "witness": copy}, test_names=("witness",))
    (problem,) = preflight(session)
    assert "witness" in problem and "camera cam0" in problem


@pytest.mark.parametrize(("one", "other"), [("a.jpg", "b.jpg"), ("a.dng", "b.nef")])
def test_every_photo_that_cannot_be_read_is_counted(pictures, tmp_path, one, other):
    for i in range(2 * one.endswith(".jpg")):
        write_picture(tmp_path / f"good{i}.jpg", pictures[i])
    (tmp_path / one).write_text("no picture")
    (tmp_path / other).touch()
    (problem,) = preflight(CaptureSession(static=tmp_path))
    assert one in problem and problem.endswith("(and 1 more)")


def test_all_problems_at_once(make_clip, pictures, tmp_path):
    good = make_clip("good.mp4", pictures)
    (tmp_path / "text.mp4").write_text("hello " * 100)
    (tmp_path / "zero.mp4").touch()
    (tmp_path / "nothing").mkdir()
    (tmp_path / "t.csv").write_text("cam,frame,time\n")
    session = CaptureSession(
        static=tmp_path / "nothing",
        cameras={
            "a": tmp_path / "missing.mp4",
            "b": tmp_path / "text.mp4",
            "c": tmp_path / "zero.mp4",
            "d": good,
            "e": good,
        },
        timestamps=tmp_path / "t.csv",
        board_clips={"a": tmp_path / "missing_board.mp4"},
        joint_clips={"d": good, "a": tmp_path / "text.mp4"},
    )
    problems = preflight(session)
    for camera, refusal in (("a", "file-missing"), ("b", "file-is-text"), ("c", "file-empty")):
        with refused(refusal) as why:
            probe_video(session.cameras[camera])
        assert f"capture camera {camera}: {why.value}" in problems
    for words in (
        ("capture.static", "nothing"),
        ("camera e", "good.mp4", "camera d"),
        ("board.clips.a", "missing_board.mp4"),
        ("joint_clips.a", "text.mp4"),
        ("timestamps", "t.csv", "camera, frame_index, time_s"),
    ):
        assert any(all(w in p for w in words) for p in problems), (words, problems)
    assert len(problems) == 8
    (problem,) = preflight(CaptureSession())
    assert "static" in problem and "cameras" in problem


def test_broken_photo_is_named(tmp_path):
    write_picture(tmp_path / "a.png", np.zeros((8, 8, 3), np.uint8))
    (tmp_path / "b.jpg").write_text("not a photo")
    problems = preflight(CaptureSession(static=tmp_path))
    with refused("picture-unreadable", "b.jpg") as why:
        probe_picture(tmp_path / "b.jpg")
    assert problems == [f"capture.static: {why.value}"]


@pytest.mark.parametrize(
    "rows, refusal",
    [
        ("cam0,0,1.0\ncam0,1,0.9\n", ("times-not-rising", "frame 0 (1.000000 s)", "frame 1")),
        ("cam0,0,1.0\ncam0,0,2.0\n", ("entry-twice", "line 3", "frame 0", "camera cam0")),
        ("cam0,zero,1.0\n", ("entry-wrong", "line 2", "frame_index 'zero'")),
        ("cam0,0,nan\n", ("entry-wrong", "line 2", "nan")),
        ("cam0,-1,1.0\n", ("entry-wrong", "line 2", "-1")),
        ("cam0,0\n", ("entry-wrong", "line 2", "None")),
        (f"cam0,{10**30},1.0\n", ("entry-wrong", "line 2", "1e+30")),
        ("cam1,0,1.0\n", ("camera-missing", "camera cam0", "cam1")),
    ],
)
def test_wrong_tables_of_times(tmp_path, rows, refusal):
    path = tmp_path / "t.csv"
    path.write_text(TABLE + rows)
    with refused(*refusal, kind=InputError):
        read_timestamps(path, ["cam0"])


@pytest.mark.parametrize("rows", ["cam0,0,0.0\ncam0,1,17e8\n", "cam0,0,-1e308\ncam0,7,1e308\n"])
def test_times_farther_apart_than_any_recording(tmp_path, rows):
    path = tmp_path / "t.csv"
    path.write_text(TABLE + rows)
    times = read_timestamps(path, ["cam0"])["cam0"]
    with refused("times-too-long", "camera cam0", "14400", kind=InputError):
        check_table(path, "cam0", times, None)


def test_indices_that_a_clip_has_not(make_clip, pictures, tmp_path):
    """A table with some rows too many is usual; one that has none of a clip's frames counts them otherwise."""
    clip, times = make_clip("cam0.mp4", pictures), tmp_path / "t.csv"
    for first, problems in ((0, 0), (len(pictures) - 1, 0), (len(pictures), 1), (1000, 1)):
        times.write_text(TABLE + "".join(f"cam0,{first + n},{n / 10}\n" for n in range(50)))
        found = preflight(CaptureSession(cameras={"cam0": clip}, timestamps=times))
        assert len(found) == problems
        assert all(f"index {first}" in text and f"{len(pictures)} frames" in text for text in found)


def test_table_of_times_in_any_order_with_more_columns(tmp_path):
    path = tmp_path / "t.csv"
    path.write_text("time_s,note,camera,frame_index\n2.5,x,cam0,1\n1.5,y,cam0,0\n9,z,other,0\n")
    times = read_timestamps(path, ["cam0"])
    assert list(times) == ["cam0"]
    assert times["cam0"].index.tolist() == [0, 1] and times["cam0"].time_s.tolist() == [1.5, 2.5]
