"""A test camera shapes nothing: whatever it films, all other cameras, the box and the models are the same, to the byte.

The same for pictures that are held out of the sweep, once structure from motion is done.
"""

import functools
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
import yaml
from tests.end_to_end.small_session import WITNESS, write_small_session
from tests.make.clips import film

from devrf.capture.formats import read_scene
from devrf.capture.photos.picture_files import read_pixels

SMALLER = {"canonical_iterations": 40, "motion_iterations": 8, "rays": 512, "resolution": 40}
# What a training took, which no two runs have in common.
MEASURED = {"seconds", "rays_per_s", "peak_rss_gb", "peak_gpu_gb", "tracking_s", "fine_tuning_s"}
LEFT_ASIDE = {"stamp.json", "colmap.log"}  # they tell of files, times of day and seconds
STAGES = ("ingest", "static_poses", "sync", "rig", "colour", "scene", "flow", "canonical", "deformation")


@dataclass(frozen=True)
class Session:
    """A small session whose witness can film something else."""

    scene: Path

    def run(self, until: str, *options: str) -> Path:
        """The run folder, run up to a stage on one thread."""
        command = [sys.executable, "-m", "devrf", "run", str(self.scene), "--until", until, "--device", "cpu"]
        done = subprocess.run(
            [*command, "--allow-unhealthy", "--quiet", *options],
            capture_output=True,
            text=True,
            env=os.environ | {"OMP_NUM_THREADS": "1"},
        )
        assert done.returncode == 0, done.stderr
        return self.scene.parent / "run"

    def with_clip(self, write: Callable[[Path], None] | None, folder: Path) -> "Session":
        """The same session in another folder, with another clip of the witness; None: without the witness."""
        shutil.copytree(self.scene.parent, folder, ignore=shutil.ignore_patterns("run"))
        clip, scene = folder / f"{WITNESS}.mp4", yaml.safe_load(self.scene.read_text())
        if write is None:
            del scene["capture"]["test_cameras"]
            (folder / "scene.yaml").write_text(yaml.safe_dump(scene))
            clip.unlink()
        else:
            write(clip)
        return Session(folder / "scene.yaml")


def noise(clip: Path) -> None:
    """Noise in half as many pictures, each at its own time, twice as wide and high."""
    rng = np.random.default_rng(5)
    rewrite(clip, lambda rgb: rng.integers(0, 256, rgb.shape, np.uint8).repeat(2, 0).repeat(2, 1), every=2)


def larger(clip: Path) -> None:
    """What it filmed, twice as wide and high: it keeps its place, and is the largest of all."""
    rewrite(clip, lambda rgb: rgb.repeat(2, 0).repeat(2, 1))


def black(clip: Path) -> None:
    """Nothing but black."""
    rewrite(clip, np.zeros_like)


def short(clip: Path) -> None:
    """Its first pictures: nothing of it lies in the span that is asked for."""
    rewrite(clip, lambda rgb: rgb, most=2)


def rewrite(
    clip: Path, shown: Callable[[np.ndarray], np.ndarray], every: int = 1, most: int | None = None
) -> None:
    """The clip with other pictures, and without its sound."""
    before = clip.with_suffix(".before.mp4")
    clip.rename(before)
    with av.open(str(before)) as whole:
        frames = list(whole.decode(video=0))[:most:every]
    pictures = [shown(frame.to_ndarray(format="rgb24")) for frame in frames]
    film(clip, pictures, rate=8, times_s=[frame.time for frame in frames], crf="20")
    before.unlink()


def without_witness(value: Any) -> Any:
    """What a JSON file says of all others: entries that the witness's name stands in, and what was measured, go."""
    if isinstance(value, dict):
        return {
            key: without_witness(entry)
            for key, entry in value.items()
            if WITNESS not in key and key not in MEASURED
        }
    if isinstance(value, list):
        return [without_witness(entry) for entry in value if not names_witness(entry)]
    return value


def names_witness(entry: Any) -> bool:
    """Whether an entry of a list is about the witness."""
    texts = entry.values() if isinstance(entry, dict) else [entry]
    return any(isinstance(text, str) and WITNESS in text for text in texts)


def files_of(run: Path, until: str) -> dict[str, Any]:
    """Contents of the files that stages have left, as far as they are of other cameras."""
    found: dict[str, Any] = {}
    for stage in STAGES[: STAGES.index(until) + 1]:
        for path in sorted((run / stage).rglob("*")):
            name = str(path.relative_to(run))
            if path.is_file() and path.name not in LEFT_ASIDE and WITNESS not in name:
                is_json = path.suffix == ".json" and name != "scene/scene.json"
                found[name] = without_witness(json.loads(path.read_text())) if is_json else path.read_bytes()
    return found


def cameras_in_motion(session: Session) -> set[str]:
    """Whose pictures the scene holds beside the sweep's."""
    path = session.scene.parent / "run" / "scene" / "dynamic" / "transforms.json"
    return {frame["camera"] for frame in json.loads(path.read_text())["frames"]}


def assert_alike(one: dict[str, Any], other: dict[str, Any]) -> None:
    """The same files with the same contents, or which are not."""
    assert one.keys() == other.keys()
    assert [name for name in one if one[name] != other[name]] == []


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Session:
    scene = write_small_session(tmp_path_factory.mktemp("test_cameras") / "true")
    content = yaml.safe_load(scene.read_text())
    content["reconstruct"] |= SMALLER
    scene.write_text(yaml.safe_dump(content))
    return Session(scene)


@pytest.fixture(scope="module")
def other_with(session: Session, tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Session]:
    """The session with another clip of the witness, once for each clip: a test goes on where another has ended."""
    return functools.cache(lambda clip: session.with_clip(clip, tmp_path_factory.mktemp("other") / "session"))


@pytest.mark.parametrize("clip", [noise, *(pytest.param(x, marks=pytest.mark.full) for x in (black, larger))])
def test_a_witness_changes_nothing_up_to_the_scene(
    session: Session, other_with: Callable[..., Session], clip: Callable[[Path], None]
) -> None:
    by_size = ("--set", "reconstruct.image_scale=null")  # chosen by the size of pictures
    true = files_of(session.run("scene", *by_size), "scene")
    assert "scene/scene.json" in true and any(name.startswith("ingest/frames/cam2/") for name in true)
    assert_alike(true, files_of(other_with(clip).run("scene", *by_size), "scene"))


@pytest.mark.full
def test_a_witness_changes_nothing_in_a_span_in_which_it_films_nothing(
    session: Session, other_with: Callable[..., Session]
) -> None:
    span = ("--set", "capture.range_s=[0.3, 1.9]")
    true = files_of(session.run("scene", *span), "scene")
    assert WITNESS in cameras_in_motion(session)
    other = other_with(short)
    assert_alike(true, files_of(other.run("scene", *span), "scene"))
    assert cameras_in_motion(other) == {"cam0", "cam2"}


@pytest.mark.full
@pytest.mark.parametrize("clip", [noise, None])
def test_a_witness_changes_nothing_up_to_the_models(
    session: Session, other_with: Callable[..., Session], clip: Callable[[Path], None] | None
) -> None:
    true = files_of(session.run("deformation"), "deformation")
    assert {"canonical/model.safetensors", "deformation/model.safetensors"} <= true.keys()
    assert_alike(true, files_of(other_with(clip).run("deformation"), "deformation"))


@pytest.mark.full
def test_a_training_camera_that_films_something_else_is_left_out(session: Session, tmp_path: Path) -> None:
    other = session.with_clip(noise, tmp_path / "other")
    content = yaml.safe_load(other.scene.read_text())
    cameras = content["capture"]["cameras"]
    content["capture"]["cameras"] = {"first": content["capture"].pop("test_cameras")[WITNESS], **cameras}
    content["calibration"] = {"sync": {"method": "none"}}
    other.scene.write_text(yaml.safe_dump(content))
    run = other.run("scene")
    rig = json.loads((run / "rig" / "rig.json").read_text())
    assert list(rig["left_out"]) == ["first"] and list(rig["cameras"]) == list(cameras)
    rows = json.loads((run / "rig" / "health.json").read_text())["rows"]
    assert [row["about"] for row in rows if row["code"] == "camera-left-out"] == ["first"]
    assert cameras_in_motion(other) == set(cameras)


@pytest.mark.full
def test_what_is_held_out_of_the_sweep_is_in_structure_from_motion_alone(
    session: Session, tmp_path: Path
) -> None:
    true = session.run("deformation")
    shutil.copytree(session.scene.parent, tmp_path / "other", ignore=shutil.ignore_patterns(*STAGES[2:]))
    other, run = Session(tmp_path / "other" / "scene.yaml"), tmp_path / "other" / "run"
    names = sorted(json.loads((run / "static_poses" / "static_poses.json").read_text())["frames"])
    for n, name in enumerate(names):
        if n % 8 == 0:
            path = run / "ingest" / "frames" / name
            shape = read_pixels(path).shape
            cv2.imwrite(str(path), np.random.default_rng(n).integers(0, 256, shape, np.uint8))
    other.run("deformation", "--from", "sync")
    scene = read_scene(run / "scene")
    assert scene.points is not None and "test" in {frame.split for frame in scene.static}
    assert {scene.static[n].split for n in scene.points.obs_frame} == {"train"}
    for file in ("scene/scene.json", "canonical/model.safetensors", "deformation/model.safetensors"):
        assert (run / file).read_bytes() == (true / file).read_bytes(), file
