"""Data sets as others publish them, made here by their own rules, without the shortcuts of their loaders."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.make.tables import table
from tests.refused import refused

from devrf.capture.formats import read_dataset
from devrf.capture.formats.parts.flow_files import read_flow_file
from devrf.capture.scene import background_of, load_image, plain_colour
from devrf.capture.system.errors import CaptureError

WIDTH, HEIGHT, FOCAL = 48, 32, 40.0


def picture(path: Path, width: int = WIDTH, height: int = HEIGHT, channels: int = 3) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    shape = (height, width) if channels == 1 else (height, width, channels)
    cv2.imwrite(str(path), np.full(shape, 100, np.uint8))


def opengl(angle: float) -> np.ndarray:
    """A camera on a circle of radius 4 that looks at the origin: camera-to-world, OpenGL's axes, z up."""
    back = np.array([np.cos(angle), np.sin(angle), 0.3]) / np.linalg.norm([1, 0.3])
    right = np.cross([0, 0, 1.0], back) / np.linalg.norm(np.cross([0, 0, 1.0], back))
    out = np.eye(4)
    out[:3] = np.column_stack([right, np.cross(back, right), back, 4 * back])
    return out


def transforms(
    path: Path, names: list[str], poses: list[float], entries: list[dict] | None = None, **common: object
) -> Path:
    """A file of these pictures, and the pictures; Blender's have no ending, and alpha."""
    content = []
    for name, angle, more in zip(names, poses, entries or [{}] * len(names), strict=True):
        ending, channels = ("", 3) if path.name == "transforms.json" else (".png", 4)
        picture(path.parent / f"{name}{ending}", channels=channels)
        content.append({"file_path": name, "transform_matrix": opengl(angle).tolist(), **more})
    path.write_text(json.dumps({**common, "frames": content}))
    return path.parent


@pytest.fixture
def inward(tmp_path: Path) -> Path:
    """Two views of three times in mixed order, with flow; each file has its own focal length; no validation."""
    static, dynamic = (tmp_path / name for name in ("static", "dynamic_2views"))
    for folder in (static, dynamic):
        folder.mkdir()
    names = [f"./train/r_{n}" for n in range(6)]
    transforms(static / "transforms_train.json", names, list(range(6)), camera_angle_x=1.0)
    transforms(static / "transforms_test.json", ["./test/r_0"], [0.5], camera_angle_x=0.9)
    order = [(1, 2), (0, 0), (1, 0), (0, 2), (0, 1), (1, 1)]  # (view, time)
    names = [f"./train/r_{view}_{time}" for view, time in order]
    times = [{"time": time / 2} for _, time in order]
    poses = [3.0 * view for view, _ in order]
    transforms(dynamic / "transforms_train.json", names, poses, times, camera_angle_x=0.8)
    (tmp_path / "dynamic_2views/train_flow").mkdir()
    for number, (view, time) in enumerate(order):
        if time:
            flow = np.full((HEIGHT, WIDTH, 2), [10.0 * view + time, 0], np.float32)
            mask = np.ones((HEIGHT, WIDTH), np.uint8)
            np.savez(tmp_path / f"dynamic_2views/train_flow/{number:03d}_bwd.npz", flow=flow, mask=mask)
    return tmp_path


def test_inward_order_is_not_trusted(inward: Path):
    scene = read_dataset("devrf", inward)
    views = {name: [f for f in scene.dynamic if f.camera_name == name] for name in ("view1", "view2")}
    for name, number in (("view1", 1), ("view2", 0)):  # view1 is the pose that the file names first
        frames = views[name]
        assert [(f.index, f.time) for f in frames] == [(0, 0.0), (1, 0.5), (2, 1.0)]
        assert {f.path.stem for f in frames} == {f"r_{number}_{time}" for time in range(3)}
        assert frames[0].flow is None
        for frame in frames[1:]:
            assert frame.flow is not None
            assert read_flow_file(frame.flow)[0][0, 0, 0] == 10 * number + frame.index
    assert len(scene.dynamic) == 6


def test_inward_focal_length_is_from_the_width_of_each_file(inward: Path):
    scene = read_dataset("devrf", inward)
    focal = {split: 0.5 * WIDTH / np.tan(0.5 * angle) for split, angle in (("train", 1.0), ("test", 0.9))}
    for frame in scene.static:
        np.testing.assert_allclose(np.diag(frame.camera.K)[:2], focal[frame.split])
        np.testing.assert_allclose(frame.camera.K[:2, 2], [WIDTH / 2, HEIGHT / 2])
    assert scene.dynamic[0].camera.K[0, 0] == pytest.approx(0.5 * WIDTH / np.tan(0.4))


def test_entries_may_have_their_own_intrinsics(inward: Path):
    path = inward / "static/transforms_train.json"
    meta = json.loads(path.read_text())
    meta["frames"][2] |= {"fl_x": 50.0, "fl_y": 51.0, "cx": 20.0, "cy": 15.0, "w": WIDTH, "h": HEIGHT}
    path.write_text(json.dumps(meta))
    K = read_dataset("devrf", inward).static[2].camera.K
    np.testing.assert_allclose(K, [[50, 0, 20], [0, 51, 15], [0, 0, 1]])


def test_given_flow_does_not_fit_a_stride(inward: Path):
    notes: list[str] = []
    scene = read_dataset("devrf", inward, frame_stride=2, notes=notes)
    assert all(f.flow is None for f in scene.dynamic) and len(scene.dynamic) == 4
    assert any("frame_stride is 2" in note for note in notes)


# --- forward-facing: LLFF and the published DeVRF layout ---


def llff_rows(count: int) -> np.ndarray:
    """Cameras on a patch, looking about along +y with z up: rows of poses_bounds.npy."""
    rng = np.random.default_rng(1)
    rows = []
    for n in range(count):
        turn = cv2.Rodrigues(rng.normal(0, 0.05, 3))[0]
        right, up, back = (turn @ axis for axis in ([1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]))
        centre = np.array([0.3 * (n % 3) - 0.3, 5.0, 0.2 * (n // 3)])
        matrix = np.column_stack([-up, right, back, centre, [2 * HEIGHT, 2 * WIDTH, 2 * FOCAL]])
        rows.append(np.concatenate([matrix.ravel(), [4.0 + 0.1 * n, 20.0 + n]]))
    return np.array(rows)


def published_frame(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What the published static loader makes of them: swapped axes, scaled, recentred; and its bounds."""
    poses = rows[:, :15].reshape(-1, 3, 5)
    poses = np.concatenate([poses[:, :, 1:2], -poses[:, :, 0:1], poses[:, :, 2:]], axis=2)
    scale = 1 / (0.75 * rows[:, 15:].min())
    poses[:, :, 3] *= scale
    z = poses[:, :, 2].sum(0) / np.linalg.norm(poses[:, :, 2].sum(0))
    x = np.cross(poses[:, :, 1].sum(0), z)
    x /= np.linalg.norm(x)
    mean = np.eye(4)
    mean[:3] = np.column_stack([x, np.cross(z, x), z, poses[:, :, 3].mean(0)])
    full = np.tile(np.eye(4), (len(poses), 1, 1))
    full[:, :3] = poses[:, :, :4]
    poses[:, :, :4] = (np.linalg.inv(mean) @ full)[:, :3]
    return poses, rows[:, 15:] * scale


@pytest.fixture
def forward(tmp_path: Path) -> Path:
    """Nine pictures at rest, the last three by the fixed cameras; three views of four frames, pictures halved."""
    rows = llff_rows(9)
    (tmp_path / "static").mkdir()
    np.save(tmp_path / "static/poses_bounds.npy", rows)
    for n in range(9):
        picture(tmp_path / f"static/images_2/{n:03d}.png", channels=4)
    poses, bounds = published_frame(rows)
    poses[:, :, 4] /= 2
    moving = tmp_path / "dynamic_3views"
    moving.mkdir()
    np.save(moving / "poses.npy", poses)
    np.save(moving / "bds.npy", bounds)
    for view in (1, 2, 3):
        for n in range(4):
            picture(moving / f"view{view}/images_2/{n}.png", channels=4)
            if n:
                flow = np.full((HEIGHT, WIDTH, 2), [view, n], np.float32)
                path = moving / f"view{view}/images_2_flow/{n:03d}_bwd.npz"
                path.parent.mkdir(exist_ok=True)
                np.savez(path, flow=flow, mask=np.ones((HEIGHT, WIDTH), bool))
    return tmp_path


def test_forward_layout(forward: Path):
    scene = read_dataset("devrf", forward)
    assert scene.kind == "forward" and scene.background == "white" and scene.rest_time == 0.0
    assert [f.split for f in scene.static] == ["test"] + 8 * ["train"]  # the fixed cameras' are kept
    views = {f"view{n}": [f for f in scene.dynamic if f.camera_name == f"view{n}"] for n in (1, 2, 3)}
    points = np.random.default_rng(0).uniform([-1, -4, -1], [1, 0, 1], (200, 3))
    for n, frames in enumerate(views.values()):
        assert [f.time for f in frames] == [0.0, 1 / 3, 2 / 3, 1.0]
        assert {f.split for f in frames} == {"test" if n == 2 else "train"}
        for frame in frames:  # the same camera as at rest, though its file is in another frame
            np.testing.assert_allclose(
                frame.camera.project(points), scene.static[6 + n].camera.project(points), atol=1e-6
            )
        if n < 2:
            flows = [read_flow_file(f.flow)[0][0, 0].tolist() for f in frames if f.flow is not None]
            assert flows == [[n + 1.0, k] for k in (1, 2, 3)]


@pytest.mark.parametrize("name", ["devrf", "llff"])
def test_forward_scenes_are_ready_for_ndc(forward: Path, name):
    folder = forward if name == "devrf" else forward / "static"
    scene = read_dataset(name, folder)
    assert scene.ndc == pytest.approx((WIDTH / 2 / FOCAL, HEIGHT / 2 / FOCAL))
    moved = scene.in_box_frame()
    at_rest = [f.camera for f in moved.static]
    np.testing.assert_allclose(np.mean([c.centre for c in at_rest], axis=0), 0, atol=1e-9)
    forward_axis = np.mean([c.cam_from_world[2, :3] for c in at_rest], axis=0)
    np.testing.assert_allclose(forward_axis / np.linalg.norm(forward_axis), [0, 0, 1], atol=1e-9)
    down = np.mean([c.cam_from_world[1, :3] for c in at_rest], axis=0)
    assert down[0] == pytest.approx(0, abs=1e-9) and down[1] > 0.9
    assert scene.near == pytest.approx(4 / 3) and scene.far == pytest.approx(28 / 3)
    assert scene.aabb[0, 2] == 1 and scene.aabb[1, 2] == scene.far
    poses, _ = published_frame(np.load(folder / ("static" if name == "devrf" else ".") / "poses_bounds.npy"))
    np.testing.assert_allclose([c.centre for c in at_rest], poses[:, :, 3] * [1, -1, -1], atol=1e-9)


def test_llff_pixels(forward: Path):
    """A row's columns are down, right, back: a point to the right shows right of the middle, one above, above."""
    matrix = np.load(forward / "static/poses_bounds.npy")[0, :15].reshape(3, 5)
    camera = read_dataset("llff", forward / "static").static[0].camera
    point = matrix[:, 3] - 4 * matrix[:, 2] + 0.5 * matrix[:, 1] - 0.25 * matrix[:, 0]
    expected = [WIDTH / 2 + FOCAL * 0.5 / 4, HEIGHT / 2 - FOCAL * 0.25 / 4]
    np.testing.assert_allclose(camera.project(point), expected, atol=1e-9)


def test_llff_without_alpha_has_nothing_behind_and_surroundings_on_request(forward: Path):
    for n in range(9):
        picture(forward / f"static/images_2/{n:03d}.png")
    assert read_dataset("llff", forward / "static").background == "black"
    shell = read_dataset("llff", forward / "static", background="shell")
    assert shell.background == "shell" and shell.ndc is None and shell.kind == "forward"
    np.testing.assert_array_equal(shell.aabb, [[-1.0] * 3, [1.0] * 3])


def test_the_largest_pictures_that_are_there(forward: Path):
    for n in range(9):
        picture(forward / f"static/images/{n:03d}.png", 2 * WIDTH, 2 * HEIGHT)
    camera = read_dataset("llff", forward / "static").static[0].camera
    assert (camera.width, camera.K[0, 0]) == (2 * WIDTH, 2 * FOCAL)
    (forward / "static/images/003.png").unlink()
    assert read_dataset("llff", forward / "static").static[0].camera.width == WIDTH


@pytest.mark.parametrize("small_pictures", [True, False])
def test_flow_of_smaller_copies_goes_with_larger_pictures(forward: Path, small_pictures):
    """`images_2_flow` has the size of `images_2`, whether these are still there or not."""
    for view in (forward / "dynamic_3views").glob("view*"):
        for n in range(4):
            picture(view / f"images/{n}.png", 2 * WIDTH, 2 * HEIGHT)
            if not small_pictures:
                (view / f"images_2/{n}.png").unlink()
    frames = [f for f in read_dataset("devrf", forward).dynamic if f.camera_name == "view1"]
    assert frames[0].camera.width == 2 * WIDTH and sum(f.flow is not None for f in frames) == 3
    path = forward / "dynamic_3views/view2/images_2_flow/002_bwd.npz"
    shape = (2 * HEIGHT, 2 * WIDTH)
    np.savez(path, flow=np.zeros((*shape, 2)), mask=np.ones(shape))
    with refused("flow-size-wrong", "002_bwd.npz", "[32, 48, 2]", kind=CaptureError):
        read_dataset("devrf", forward)


def test_fixed_cameras_that_are_not_the_last_at_rest_are_refused(forward: Path):
    path = forward / "dynamic_3views/poses.npy"
    np.save(path, np.load(path)[::-1])
    with refused("pose-differs", "poses.npy", "view1", "static/", kind=CaptureError):
        read_dataset("devrf", forward)


# --- nerfstudio ---


def nerfstudio(folder: Path, times: list[float | None], **more: object) -> None:
    names = [f"images/{n}.png" for n in range(len(times))]
    entries = [{} if time is None else {"time": time} for time in times]
    folder.mkdir(exist_ok=True)
    transforms(
        folder / "transforms.json", names, [n % 3 for n in range(len(times))], entries, fl_x=FOCAL, **more
    )
    for n, name in enumerate(names):  # the same look of the same place would be the same picture
        cv2.imwrite(str(folder / name), np.full((HEIGHT, WIDTH, 3), 100 + n, np.uint8))


def test_nerfstudio_seconds_are_rescaled_and_said(tmp_path: Path):
    nerfstudio(tmp_path, [None, None, None, 10.0, 10.5, 11.0, 12.0, 13.0, 14.0])
    notes: list[str] = []
    scene = read_dataset("nerfstudio", tmp_path, notes=notes)
    assert [f.time for f in scene.dynamic] == [0.0, 0.125, 0.25, 0.5, 0.75, 1.0]
    assert (scene.t0_s, scene.t1_s) == pytest.approx((10.0, 14.0))
    assert any("from 10 to 14" in note for note in notes)
    assert [f.camera_name for f in scene.dynamic] == 2 * ["view1", "view2", "view3"]  # by their poses
    assert [f.index for f in scene.dynamic] == [0, 0, 0, 1, 1, 1]


def test_nerfstudio_pictures_of_one_moment_are_at_rest(tmp_path: Path):
    nerfstudio(tmp_path, [0.0] * 4)
    notes: list[str] = []
    scene = read_dataset("nerfstudio", tmp_path, notes=notes)
    assert (len(scene.static), len(scene.dynamic)) == (4, 0)
    assert {(f.time, f.time_s) for f in scene.static} == {(None, None)}
    assert any("the time 0" in note for note in notes)


def test_nerfstudio_lists_of_test_pictures(tmp_path: Path):
    nerfstudio(tmp_path, [None] * 4, test_filenames=["images/2.png"], train_filenames=["images/0.png"])
    assert [f.split for f in read_dataset("nerfstudio", tmp_path).static] == [
        "train",
        "train",
        "test",
        "train",
    ]


@pytest.mark.parametrize(
    "name",
    ["./images/2.png", "images\\2.png", "2.png", "2", "images/2", "IMAGES/2.PNG", "/a/set/images/2.png"],
)
@pytest.mark.parametrize("form", ["nerfstudio", "llff"])
def test_names_in_a_list_of_test_pictures(tmp_path: Path, forward: Path, form, name: str):
    """However they are written; a name that means no picture is said."""
    notes: list[str] = []
    folder = tmp_path / "set"
    if form == "llff":
        shutil.move(forward / "static", folder)
        for n in range(9):
            (folder / f"images_2/{n:03d}.png").rename(folder / f"images_2/{n}.png")
        (folder / "test.txt").write_text(f"{name}\n\ngone.png\n", encoding="utf-8-sig")
    else:
        nerfstudio(folder, [None] * 4, val_filenames=[name, "gone.png"])
    frames = read_dataset(form, folder, notes=notes).static
    assert [f.path.name for f in frames if f.split == "test"] == ["2.png"]
    assert [note for note in notes if "1 of 2 names" in note and note.endswith("several: gone.png")]


def test_a_list_of_test_pictures_that_names_none_is_no_list(tmp_path: Path):
    notes: list[str] = []
    nerfstudio(tmp_path, [None] * 4, test_filenames=["a.png", "b.png"])
    frames = read_dataset("nerfstudio", tmp_path, holdout_every=2, notes=notes).static
    assert [f.split for f in frames] == [
        "test",
        "train",
        "test",
        "test",
    ]  # the last from the place of the first
    assert any("2 of 2 names" in note and "a.png, b.png; no test picture" in note for note in notes)
    (tmp_path / "other").mkdir()
    for n in range(4):  # two folders with pictures of the same name: 1.png is either
        cv2.imwrite(str(tmp_path / f"other/{n}.png"), np.full((HEIGHT, WIDTH, 3), 50 + n, np.uint8))
    meta = json.loads((tmp_path / "transforms.json").read_text())
    meta["frames"] += [{**e, "file_path": e["file_path"].replace("images", "other")} for e in meta["frames"]]
    for listed, test in (("1.png", []), ("set/other/1", ["other"])):
        meta["test_filenames"] = [listed, "images/0.png"]
        (tmp_path / "transforms.json").write_text(json.dumps(meta))
        frames = read_dataset("nerfstudio", tmp_path).static
        assert [f.path.parent.name for f in frames if f.split == "test"] == ["images", *test]
    meta["test_filenames"] = "images/0.png"
    (tmp_path / "transforms.json").write_text(json.dumps(meta))
    with refused("entry-wrong", "test_filenames", kind=CaptureError):
        read_dataset("nerfstudio", tmp_path)


# --- backgrounds ---


def test_background_of_a_data_set(inward: Path):
    assert read_dataset("devrf", inward).background == "white"
    assert read_dataset("devrf", inward, background="black").background == "black"
    scene = read_dataset("devrf", inward, background=background_of((1.0, 0.5, 0.0)))
    assert scene.background == "#ff8000"
    frame = scene.static[0]
    cv2.imwrite(str(frame.path), np.zeros((HEIGHT, WIDTH, 4), np.uint8))
    assert load_image(frame, 1.0, scene.background)[0, 0].tolist() == [255, 128, 0]


def test_names_of_plain_colours():
    assert background_of((1.0, 1.0, 1.0)) == "white" and background_of((0.0, 0.0, 0.0)) == "black"
    assert plain_colour("shell") is None and plain_colour("#0000ff") == (0.0, 0.0, 1.0)
    with pytest.raises(ValueError, match="#12345"):
        plain_colour("#12345")


def test_names_as_windows_writes_them(tmp_path: Path):
    files = ["images/0.png", "images/1.JPG", "images/2.png", "masks/0.png"]
    for file in files:
        picture(tmp_path / file)
    names = ["images\\0.png", "images\\1.jpg", ".\\images\\2"]
    entries = [{"file_path": n, "transform_matrix": opengl(k).tolist()} for k, n in enumerate(names)]
    entries[0]["mask_path"] = "masks\\0.PNG"
    meta = {"camera_angle_x": 0.8, "frames": entries, "test_filenames": ["images/1.jpg"]}
    (tmp_path / "transforms.json").write_text(json.dumps(meta))
    frames = read_dataset("nerfstudio", tmp_path).static
    assert [f.path.name for f in frames] == ["0.png", "1.JPG", "2.png"]
    assert [f.split for f in frames] == ["train", "test", "train"]
    assert frames[0].matte == tmp_path / files[3]


@pytest.mark.parametrize("place", ["C:\\set\\", "/home/someone/set/", "\\\\server\\share\\set\\"])
def test_whole_paths_of_another_machine(tmp_path: Path, place: str):
    """They lead to the file that lies in the data set under their longest end."""
    for file in ("images/0.png", "images/1.png", "0.png", "masks/0.png"):
        picture(tmp_path / file)
    slash = place[-1]
    entries = [
        {"file_path": f"{place}images{slash}{n}.png", "transform_matrix": opengl(n).tolist()}
        for n in range(2)
    ]
    entries[0]["mask_path"] = f"{place}masks{slash}0.png"
    (tmp_path / "transforms.json").write_text(json.dumps({"camera_angle_x": 0.8, "frames": entries}))
    frames = read_dataset("nerfstudio", tmp_path).static
    assert [f.path for f in frames] == [tmp_path / f"images/{n}.png" for n in range(2)]
    assert frames[0].matte == tmp_path / "masks/0.png"
    (tmp_path / "images/1.png").unlink()
    with refused("picture-missing", f"{place}images{slash}1.png", str(tmp_path), kind=CaptureError):
        read_dataset("nerfstudio", tmp_path)


def test_a_backslash_in_the_name_of_a_file_stays_one(tmp_path: Path):
    names = ["a\\0.png", "a\\1.png"]
    for n in range(2):
        picture(tmp_path / f"a/{n}.png")
    transforms(tmp_path / "transforms.json", names, [0, 1], camera_angle_x=0.8)
    assert [f.path.name for f in read_dataset("nerfstudio", tmp_path).static] == names


LENS = {"fl_x": 40.0, "fl_y": 40.0, "k1": 0.05, "k2": -0.02}
TABLE = table("lenses")


def lens_set(folder: Path, common: dict, entry: dict) -> Path:
    """Two pictures with these keys for the whole file and for each entry."""
    return transforms(folder / "transforms.json", ["0.png", "1.png"], [0, 1], [entry] * 2, **common)


@pytest.mark.parametrize(("common", "entry", "model", "distortion"), TABLE["read"])
def test_lenses_by_the_words_of_others(tmp_path: Path, common, entry, model, distortion):
    camera = read_dataset("nerfstudio", lens_set(tmp_path, {**LENS, **common}, entry)).static[0].camera
    assert (camera.model, camera.distortion.tolist()) == (model, distortion)


@pytest.mark.parametrize(("common", "code", "named"), TABLE["refused"])
def test_lenses_that_are_not_read_are_refused_by_name(tmp_path: Path, common, code, named):
    with refused(code, "frames[0]", *named, kind=CaptureError):
        read_dataset("nerfstudio", lens_set(tmp_path, {**LENS, **common}, {}))


def test_one_picture_at_the_origin_is_no_scene(tmp_path: Path):
    lens_set(tmp_path, LENS, {})
    meta = json.loads((tmp_path / "transforms.json").read_text())
    entry = meta["frames"][0] | {"transform_matrix": np.eye(4).tolist()}
    (tmp_path / "transforms.json").write_text(json.dumps(meta | {"frames": [entry]}))
    with np.errstate(all="ignore"), refused("scene-cameras-unusable", tmp_path, kind=CaptureError):
        read_dataset("nerfstudio", tmp_path)


@pytest.mark.parametrize("name", ["nerfstudio", "blender"])
def test_pixels_that_are_not_square(tmp_path: Path, name):
    angles = {"camera_angle_x": 2 * np.arctan(24 / 40), "camera_angle_y": 2 * np.arctan(16 / 44)}
    lens_set(tmp_path, angles, {})
    if name == "blender":
        (tmp_path / "transforms.json").rename(tmp_path / "transforms_train.json")
    K = read_dataset(name, tmp_path).static[0].camera.K
    np.testing.assert_allclose([K[0, 0], K[1, 1]], [40, 44])


@pytest.mark.parametrize("name", ["blender", "nerfstudio"])
def test_test_pictures_that_alone_have_other_times_are_not_used(tmp_path: Path, name):
    """As D-NeRF's test files beside a sweep: there is no motion to learn, and so none to measure."""
    static, moving = ["a/0", "a/1", "a/2"], ["a/3", "a/4"]
    times = [{"time": 0.25}, {"time": 0.75}]
    if name == "blender":
        transforms(tmp_path / "transforms_train.json", static, [0, 1, 2], camera_angle_x=0.8)
        transforms(tmp_path / "transforms_test.json", moving, [3, 4], times, camera_angle_x=0.8)
    else:
        names = [f"{n}.png" for n in (*static, *moving)]
        entries = [*({"split": "train"} for _ in static), *({**t, "split": "test"} for t in times)]
        transforms(tmp_path / "transforms.json", names, list(range(5)), entries, camera_angle_x=0.8)
    for n, file in enumerate(sorted((tmp_path / "a").glob("*"))):
        cv2.imwrite(str(file), np.full((HEIGHT, WIDTH, 3), 90 + n, np.uint8))
    notes: list[str] = []
    scene = read_dataset(name, tmp_path, holdout_every=3, notes=notes)
    assert [f.path.stem for f in scene.static] == ["0", "1", "2"] and not scene.dynamic
    assert {f.split for f in scene.static} == {"train", "test"}
    assert any(note.startswith("2 test pictures have a") and "not used" in note for note in notes)
    if name == "blender":
        transforms(tmp_path / "transforms_train.json", moving, [3, 4], times, camera_angle_x=0.8)
        with refused("rest-missing", tmp_path, kind=CaptureError):
            read_dataset(name, tmp_path)


@pytest.mark.parametrize(
    "names",
    [
        [f"{n}.png" for n in (1, 10, 11, 2, 3, 7, 8, 9, 91)],  # as numpy.argsort of the names has them
        ["IMG_2.png", "IMG_3.png", *(f"img_{n}.png" for n in (1, 10, 2, 3, 4, 5, 6))],
    ],
)
@pytest.mark.parametrize("name", ["devrf", "llff"])
def test_rows_belong_to_names_by_code_points(forward: Path, name, names: list[str]):
    folder = forward if name == "devrf" else forward / "static"
    notes: list[str] = []
    before = read_dataset(name, folder, notes=notes)
    assert not any("order" in note for note in notes)
    for n, new in enumerate(names):
        (forward / f"static/images_2/{n:03d}.png").rename(forward / "static/images_2" / new)
    after = read_dataset(name, folder, notes=notes)
    assert [f.path.name for f in after.static] == names
    for a, b in zip(before.static, after.static, strict=True):
        np.testing.assert_array_equal(a.camera.cam_from_world, b.camera.cam_from_world)
    assert [", ".join(names[:3]) in note for note in notes if "order" in note] == [True]
    if name == "devrf":  # frames of a view stand in the order of their numbers
        for n in range(4):
            (forward / f"dynamic_3views/view1/images_2/{n}.png").rename(
                forward / f"dynamic_3views/view1/images_2/{8 + n}.png"
            )
        moved = [f.path.name for f in read_dataset(name, folder).dynamic if f.camera_name == "view1"]
        assert moved == ["8.png", "9.png", "10.png", "11.png"]


def test_points_that_name_no_pictures_are_counted(tmp_path: Path):
    (tmp_path / "a.ply").write_bytes(
        b"ply\nformat ascii 1.0\nelement vertex 300\nproperty float x\nend_header\n"
    )
    for name, count in (("a.ply", 1), (".\\a.ply", 1), ("b.ply", 0)):
        notes: list[str] = []
        read_dataset("nerfstudio", lens_set(tmp_path, {**LENS, "ply_file_path": name}, {}), notes=notes)
        assert [note.startswith("300 points") for note in notes] == [True] * count
