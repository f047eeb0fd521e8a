"""Damage to raw files: clips written anew into the case's folder; of a data set, its list of pictures thinned."""

import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import numpy as np

from devrf.capture.scene import Scene
from devrf.lab.bench.stability.damage.intact import (
    Damage,
    DoesNotApply,
    Intact,
    behind_scene,
    with_capture,
)
from devrf.lab.simulate.session.damage import Picture, blurred, relit, write_again
from devrf.lab.sources import code_of
from devrf.pipelines.config.scene import SceneConfig
from devrf.pipelines.stamps.digests import file_digest


def fewer_sweep_pictures(intact: Intact) -> Damage:
    """Only every n-th picture of the sweep's clip; of a data set's pictures at rest."""
    every = int(intact.severity)
    if intact.capture is not None:
        return _part_of_the_sweep(intact, lambda number, count: number % every == 0)
    if intact.scene.points is not None:
        text = "the sparse points of a data set name its pictures by their places"
        raise DoesNotApply("sweep-points-placed", text)

    def thin(scene: Scene) -> Scene:
        train = [frame.path for frame in scene.static if frame.split == "train"]
        left_out = set(train) - set(train[::every])
        return replace(scene, static=tuple(frame for frame in scene.static if frame.path not in left_out))

    return behind_scene(intact, thin)


def partial_sweep(intact: Intact) -> Damage:
    """The sweep's clip without so many percent of it at its end: places that it never went to."""
    return _part_of_the_sweep(intact, lambda number, count: number < round((1 - intact.share) * count))


def blurred_sweep(intact: Intact) -> Damage:
    """All pictures of the sweep's clip blurred sideways by so many percent of their width."""

    def blur(picture: Picture, when: float) -> Picture:
        return blurred(picture, intact.share)

    return Damage(_with_sweep(intact, lambda old, new: write_again(old, new, change=blur)))


def lower_frame_rate(intact: Intact) -> Damage:
    """Only every n-th picture of every training camera: the motion between two pictures is so many times as large."""
    every = int(intact.severity)
    return _fewer_frames(intact, intact.cameras, lambda number, count: number % every == 0)


def dropped_frames(intact: Intact) -> Damage:
    """So many percent of the last training camera's pictures lost, drawn at random; the first and last stay."""

    @cache
    def lost(count: int) -> frozenset[int]:
        drawn = intact.rng.permutation(np.arange(1, count - 1))[: round(intact.share * (count - 2))]
        return frozenset(drawn.tolist())

    def stays(number: int, count: int) -> bool:
        return number not in lost(count)

    return _fewer_frames(intact, intact.cameras[-1:], stays)


def drifting_exposure(intact: Intact) -> Damage:
    """The exposure of every training camera changes by so many stops over its clip, of every other the other way."""
    return _drifting(intact, (1.0, 1.0, 1.0))


def drifting_white_balance(intact: Intact) -> Damage:
    """So many stops more red and fewer blue over the clip, in every other training camera the other way."""
    return _drifting(intact, (1.0, 0.0, -1.0))


def _drifting(intact: Intact, stops: tuple[float, float, float]) -> Damage:
    def write(name: str, old: Path, new: Path) -> None:
        sign = 1 if intact.cameras.index(name) % 2 else -1  # the first grows darker
        ends = sign * intact.severity * np.array(stops)
        write_again(old, new, change=lambda picture, when: relit(picture, when * ends))

    return Damage(_with_clips(intact, intact.cameras, write))


def _fewer_frames(intact: Intact, cameras: Sequence[str], stays: Callable[[int, int], bool]) -> Damage:
    """Some pictures of some training cameras left out; `stays` is given a picture's number and their count."""
    if intact.capture is not None:
        return Damage(_with_clips(intact, cameras, lambda name, old, new: write_again(old, new, stays)))

    def thin(scene: Scene) -> Scene:
        left_out: set[Path] = set()
        for name in cameras:
            paths = [frame.path for frame in scene.dynamic if frame.camera_name == name]
            left_out |= {path for n, path in enumerate(paths) if not stays(n, len(paths))}
        # What the data set brings as flow leads to the picture before, which may be gone.
        dynamic = (replace(f, flow=None) if f.camera_name in cameras else f for f in scene.dynamic)
        return replace(scene, dynamic=tuple(f for f in dynamic if f.path not in left_out))

    return behind_scene(intact, thin)


def _part_of_the_sweep(intact: Intact, stays: Callable[[int, int], bool]) -> Damage:
    """Some pictures of the sweep's clip, and a truth that knows of no others."""
    config = _with_sweep(intact, lambda old, new: write_again(old, new, stays))
    truth = intact.config.truth_path(intact.scene_dir)
    if truth is None:
        return Damage(config)
    content = json.loads(truth.read_text())
    static = content.get("static") or []
    content["static"] = [pose for n, pose in enumerate(static) if stays(n, len(static))]
    fewer = intact.folder / "ground_truth.json"
    fewer.write_text(json.dumps(content))
    for masks in truth.parent.glob("*_mask.npz"):  # what moves is measured as in the undisturbed scene
        shutil.copyfile(masks, intact.folder / masks.name)
    evaluate = config.evaluate.model_copy(update={"truth": str(fewer)})
    return Damage(config.model_copy(update={"evaluate": evaluate}))


def _with_sweep(intact: Intact, write: Callable[[Path, Path], None]) -> SceneConfig:
    """The sweep's clip written anew, if it is not there yet."""
    capture = intact.capture
    if capture is None or capture.static is None:
        raise DoesNotApply("sweep-clip-missing", "a data set brings no clip of its sweep")
    source = intact.config.path(intact.scene_dir, capture.static)
    if source.is_dir():
        raise DoesNotApply("sweep-is-photos", "the sweep is a folder of photos, expected a clip")
    target = intact.folder / "static.mp4"
    _written(intact, source, target, write)
    return with_capture(intact.config, static=str(target))


def _written(intact: Intact, source: Path, target: Path, write: Callable[[Path, Path], None]) -> None:
    """A clip written anew, once: `NAME.json` beside it, written last, says of what and how it was made.

    Of what axis says the folder, which is the case's own.
    """
    said = target.with_suffix(".json")
    of = {
        "code": code_of("lab/bench/stability/damage", "lab/simulate/session"),
        "severity": intact.severity,
        "seed": intact.seed,
        "cameras": intact.cameras,
        "source": file_digest(source),
    }
    if target.is_file() and said.is_file() and said.read_text() == json.dumps(of):
        return
    said.unlink(missing_ok=True)
    write(source, target)
    said.write_text(json.dumps(of))


def _with_clips(
    intact: Intact, names: Sequence[str], write: Callable[[str, Path, Path], None]
) -> SceneConfig:
    """Clips of fixed cameras written anew, where they are not there yet."""
    capture = intact.capture
    if capture is None:
        raise DoesNotApply("camera-clips-missing", "a data set brings no clips of its cameras")
    if capture.timestamps is not None:
        text = "the times of the clips' pictures are in a file of their own"
        raise DoesNotApply("timestamps-in-file", text)
    cameras = dict(capture.cameras)
    for name in names:
        source, target = intact.config.path(intact.scene_dir, cameras[name]), intact.folder / f"{name}.mp4"
        _written(intact, source, target, partial(write, name))
        cameras[name] = str(target)
    return with_capture(intact.config, cameras=cameras)
