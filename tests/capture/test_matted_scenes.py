"""A picture with a matte beside it is a picture with alpha: loaded, exported, read again."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.refused import refused

from devrf.capture.formats import WRITERS, read_dataset, write_dataset
from devrf.capture.formats.parts.files import read_json, write_json
from devrf.capture.formats.parts.scene_files import read_scene, write_scene
from devrf.capture.photos.picture_files import read_pixels, write_png
from devrf.capture.scene import PosedFrame, Scene, load_image, read_opacity
from devrf.capture.system.errors import CaptureError


@pytest.fixture
def matted(odd_scene: Scene, tmp_path: Path) -> Scene:
    """Every picture with a soft disc as its matte."""

    def with_matte(frame: PosedFrame) -> PosedFrame:
        camera = frame.camera
        disc = np.zeros((camera.height, camera.width), np.uint8)
        cv2.circle(disc, (camera.width // 2, camera.height // 2), camera.height // 3, 255, -1)
        path = tmp_path / "mattes" / frame.path.name
        path.parent.mkdir(exist_ok=True)
        write_png(path, cv2.GaussianBlur(disc, (0, 0), 1.5))
        return replace(frame, matte=path)

    static, dynamic = (tuple(with_matte(f) for f in part) for part in (odd_scene.static, odd_scene.dynamic))
    return replace(odd_scene, static=static, dynamic=dynamic, background="white")


def with_alpha(frame: PosedFrame, folder: Path) -> PosedFrame:
    """The same as one file."""
    assert frame.matte is not None
    path = folder / f"rgba_{frame.path.name}"
    write_png(path, np.dstack([read_pixels(frame.path), read_pixels(frame.matte)[..., 0]]))
    return replace(frame, path=path, matte=None)


@pytest.mark.parametrize("scale", [1.0, 0.5])
@pytest.mark.parametrize("background", ["white", "black", "#336699"])
def test_it_is_loaded_as_a_picture_with_alpha(
    matted: Scene, tmp_path: Path, scale: float, background: str
) -> None:
    frame = matted.dynamic[3]
    same = with_alpha(frame, tmp_path)
    np.testing.assert_array_equal(load_image(frame, scale, background), load_image(same, scale, background))
    ours, theirs = read_opacity(frame, background), read_opacity(same, background)
    assert ours is not None and theirs is not None
    np.testing.assert_array_equal(ours, theirs)
    np.testing.assert_array_equal(load_image(frame, 1.0, "shell"), read_pixels(frame.path))
    assert read_opacity(frame, "shell") is None


def test_a_matte_of_another_size_is_refused(matted: Scene, tmp_path: Path) -> None:
    write_png(tmp_path / "small.png", np.zeros((10, 20), np.uint8))
    frame = replace(matted.static[0], matte=tmp_path / "small.png")
    with refused("matte-size-wrong", "small.png", "20x10", "96x64", kind=CaptureError):
        load_image(frame, 1.0, "white")


def test_our_scene_keeps_it(matted: Scene, tmp_path: Path) -> None:
    (tmp_path / "scene").mkdir()
    write_scene(tmp_path / "scene", matted)
    assert [f.matte for f in read_scene(tmp_path / "scene").frames] == [f.matte for f in matted.frames]
    entry = read_json(tmp_path / "scene" / "static" / "transforms.json")["frames"][0]
    assert entry["mask_path"] == "../../mattes/static_0.png"


@pytest.mark.parametrize("name", WRITERS)
def test_exports_carry_it_as_alpha(matted: Scene, tmp_path: Path, name) -> None:
    write_dataset(name, matted, tmp_path / "out")
    again = read_dataset(name, tmp_path / "out")
    assert again.background == "white"
    frame, source = again.static[0], matted.static[0]
    opacity = read_opacity(frame, "white")
    assert opacity is not None and 0.1 < (opacity > 127).mean() < 0.6
    np.testing.assert_array_equal(load_image(frame, 1.0, "white"), load_image(source, 1.0, "white"))
    write_dataset(name, replace(matted, background="shell"), tmp_path / "room")
    seen = read_opacity(read_dataset(name, tmp_path / "room").static[0], "white")
    assert seen is None or (seen == 255).all()  # where surroundings are seen nothing is cut out


def test_masks_of_other_programs_need_a_word(matted: Scene, tmp_path: Path) -> None:
    """nerfstudio's masks may also say what to leave out: they count only where the background is said to be plain."""
    write_dataset("nerfstudio", replace(matted, background="shell"), tmp_path / "out")
    path = tmp_path / "out" / "transforms.json"
    meta = read_json(path)
    del meta["devrf_scene"]
    (tmp_path / "out" / "masks").mkdir()
    for n, entry in enumerate(meta["frames"]):
        size = (entry["h"], entry["w"])
        write_png(tmp_path / "out" / "masks" / f"{n}.png", np.full(size, 255 * (n % 2), np.uint8))
        entry["mask_path"] = f"masks/{n}.png"
    write_json(path, meta)
    notes: list[str] = []
    assert read_dataset("nerfstudio", tmp_path / "out", notes=notes).background == "shell"
    assert any("mask_path" in note for note in notes)
    notes.clear()
    plain = read_dataset("nerfstudio", tmp_path / "out", background="white", notes=notes)
    assert all("ply_file_path" in note for note in notes)  # whose points name no pictures here
    assert (load_image(plain.static[0], 1.0, "white") == 255).all()
    (tmp_path / "out" / "masks" / "0.png").unlink()
    with refused("picture-missing", "masks/0.png", kind=CaptureError):
        read_dataset("nerfstudio", tmp_path / "out")
