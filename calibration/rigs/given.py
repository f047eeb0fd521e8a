"""A calibration that people already own, fitted to the cameras of a capture: names, picture sizes, unit of length.

A file may hold a whole rig, or intrinsics only; these then serve as a board calibration would.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from types import MappingProxyType
from typing import Protocol, runtime_checkable

import numpy as np

from devrf.calibration.formats import (
    READ,
    FoundCalibration,
    FoundCamera,
    find_calibration,
    find_single_files,
    is_json_of_others,
)
from devrf.calibration.intrinsics import Intrinsics
from devrf.calibration.rigs.rig import ARBITRARY, Rig, RigCamera, Scale, read_rig
from devrf.capture.measure import Measure, noted
from devrf.capture.orientation import Upright
from devrf.capture.photos.picture_files import natural_key
from devrf.capture.system.errors import InputError

KEY = "calibration.rig.given"
CALIBRATION = "given calibration"
METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001}
# Cameras farther apart are in millimetres where a format does not say its unit, else a warning.
LARGEST_RIG_M = 50.0
# A principal point farther off the middle belongs to another picture size (of a size unsaid).
CENTRE_SHARE = 0.25
SAME_ASPECT = 0.01  # relative; sizes of pictures with square pixels are rounded
LEAST_FOCAL, MOST_FOCAL = 0.02, 1000.0  # of the longer side: beyond any fisheye, and a telescope's
FARTHEST_CENTRE = 2.0  # of a principal point from the middle, in pictures; lenses that shift have half of one
MOST_DISTORTION = 1e6  # long lenses have coefficients of hundreds
FARTHEST = 1e9  # of the world's origin from a camera: a thousand kilometres in millimetres


@runtime_checkable
class ClipGeometry(Protocol):
    """What a clip says of its pictures beside their size: how they were made upright, and how wide a pixel is."""

    @property
    def upright(self) -> Upright: ...
    @property
    def pixel_aspect(self) -> float: ...


@dataclass(frozen=True)
class Given:
    """What a calibration says about the cameras of a capture.

    Attributes:
        format: In words.
        rig: The cameras in one world; None where the file has intrinsics only.
        intrinsics: Of each camera.
        measures: What was assumed or changed.
    """

    format: str
    rig: Rig | None
    intrinsics: dict[str, Intrinsics]
    measures: tuple[Measure, ...]


def read_given(
    source: Path | Mapping[str, Path],
    names: list[str],
    sizes: Mapping[str, tuple[int, int]],
    unit: str | None = None,
    known_distance_m: float | None = None,
    clips: Mapping[str, ClipGeometry] = MappingProxyType({}),
) -> Given:
    """Read a calibration in any known format (`devrf.calibration.formats`), or our own rig.json.

    Args:
        source: A file or folder; or camera name -> OpenCV file of that camera.
        names: Cameras of the capture; each must be in it.
        sizes: Picture sizes of their clips, pixels.
        unit: Unit of the file's lengths (m, cm, mm), where its owner knows better than the format.
        known_distance_m: Between the first two cameras: gives metres where the file has none.
        clips: What else the clips say of their pictures; those that are missing are upright as stored, pixels square.
    Raises:
        InputError: Another format, a camera that is missing, or a calibration for other pictures.
        CaptureError: A damaged COLMAP model.
    """
    own = None
    if isinstance(source, Path) and _is_json(source) and not is_json_of_others(source):
        own = _own_rig(source)
    found = _found(source) if own is None else _own(own)
    where = str(source) if isinstance(source, Path) else KEY
    notes = noted([f"{found.format}, {len(found.cameras)} cameras", *found.notes], CALIBRATION)
    chosen, assumed = _match(names, list(found.cameras), where)
    notes += assumed
    fitted: dict[str, FoundCamera] = {}
    for name in names:
        fitted[name], said = _fitted(name, found.cameras[chosen[name]], sizes[name], clips.get(name), where)
        _check_plausible(name, fitted[name], sizes[name], where)
        notes += said
    intrinsics = {
        name: Intrinsics(*sizes[name], c.K, c.distortion, None, c.model) for name, c in fitted.items()
    }
    without = [name for name, camera in fitted.items() if camera.cam_from_world is None]
    if without:
        if len(without) < len(fitted):
            notes += noted([f"poses are not used: the file has none of {', '.join(without)}"], CALIBRATION)
        return Given(found.format, None, intrinsics, tuple(notes))
    scale, assumed = _scale(found, fitted, names, unit, known_distance_m)
    notes += assumed
    cameras = {name: _placed(intrinsics[name], fitted[name], scale.factor) for name in names}
    if own is not None and scale.factor == 1:  # its doubts are still true
        cameras = {name: replace(own.cameras[chosen[name]], camera=c.camera) for name, c in cameras.items()}
        scale = own.scale if unit is None else scale
    _check_apart(cameras, where)
    return Given(found.format, Rig(cameras, replace(scale, factor=1.0), "given"), intrinsics, tuple(notes))


def _found(source: Path | Mapping[str, Path]) -> FoundCalibration:
    return find_calibration(source) if isinstance(source, Path) else find_single_files(source)


def _placed(intrinsics: Intrinsics, camera: FoundCamera, metres: float) -> RigCamera:
    """A camera at its pose, in metres."""
    T = np.array(camera.cam_from_world)
    T[:, 3] *= metres
    return RigCamera(intrinsics.at(T), "given")


def _is_json(path: Path) -> bool:
    if path.suffix.lower() == ".json" or not path.is_file():
        return path.suffix.lower() == ".json"
    try:
        with path.open("rb") as file:
            return file.read(64).lstrip().startswith(b"{")
    except OSError:
        return False  # its reader says what is wrong


def _own_rig(path: Path) -> Rig:
    try:
        return read_rig(path)
    except InputError as error:
        others = f"; of other programs are read: {READ}" if error.code == "file-damaged" else ""
        raise InputError(error.code, f"{error}{others}") from None


def _own(rig: Rig) -> FoundCalibration:
    """Our rig.json as any other calibration."""
    cameras = {}
    for name, c in rig.cameras.items():
        size = (c.camera.width, c.camera.height)
        cameras[name] = FoundCamera(
            c.camera.K, c.camera.distortion, c.camera.model, size, c.camera.cam_from_world
        )
    return FoundCalibration("devrf rig.json", cameras, "m" if rig.scale.metric else "arbitrary")


def _match(names: list[str], found: list[str], where: str) -> tuple[dict[str, str], list[Measure]]:
    """The capture's name -> the file's: the same, else the same number, the end of it, or the place in the order."""
    if set(names) <= set(found):
        return {name: name for name in names}, []
    ours, theirs = [_number(name) for name in names], [_number(name) for name in found]
    unique = len(set(ours)) == len(ours) and len(set(theirs)) == len(theirs)
    if unique and None not in ours and set(ours) <= set(theirs):
        chosen = {name: found[theirs.index(number)] for name, number in zip(names, ours, strict=True)}
        return chosen, noted([f"matched by number: {_pairs(chosen)}"], CALIBRATION)
    ends = {n: [f for f in found if re.search(rf"[\W_]{re.escape(f)}$", n)] for n in names}
    if all(len(ending) == 1 for ending in ends.values()) and len({f for [f] in ends.values()}) == len(names):
        chosen = {name: f for name, [f] in ends.items()}
        return chosen, noted([f"matched by the end of the name: {_pairs(chosen)}"], CALIBRATION)
    # where some agree, one is missing, not renamed
    if len(names) == len(found) and not set(names) & set(found):
        chosen = dict(zip(names, sorted(found, key=natural_key), strict=True))
        found_as = "warn" if len(names) > 1 else "ok"
        text = f"matched by order: {_pairs(chosen)}"
        return chosen, [Measure("given-assumed", text, "cameras", "order", {"where": where}, found_as)]
    missing = [name for name in names if name not in found]
    wrong = f"{where}: has no camera {', '.join(missing)}; it has {', '.join(found) or 'none'}"
    remedy = f"the capture has {', '.join(names)}; name capture.cameras as the calibration does"
    raise InputError("camera-missing", f"{wrong}, {remedy}")


def _number(name: str) -> int | None:
    digits = re.findall(r"\d+", name)
    return int(digits[-1]) if len(digits) == 1 else None


def _pairs(chosen: Mapping[str, str]) -> str:
    return ", ".join(f"{ours}: {theirs}" for ours, theirs in chosen.items())


def _fitted(
    name: str, camera: FoundCamera, size: tuple[int, int], clip: ClipGeometry | None, where: str
) -> tuple[FoundCamera, list[Measure]]:
    """A camera as its clip's pictures show it, and what was assumed for it.

    The clip's pictures are upright. A calibration whose size fits only those that are stored is of these, and is
    turned; one that fits only pictures with square pixels is of these.
    """
    upright, aspect = (Upright(), 1.0) if clip is None else (clip.upright, clip.pixel_aspect)
    stored = upright.size(*size)
    if camera.size is None:
        if _off_middle(camera, size) <= CENTRE_SHARE:
            text = f"the file has no picture size; taken as the clip's, {size[0]}x{size[1]}"
            fitted, said = replace(camera, size=size), noted([text], name)
            return fitted, said + _doubt_turn(name, upright)
        if stored == size or _off_middle(camera, stored) > CENTRE_SHARE:
            at, films = f"{camera.K[0, 2]:.0f}, {camera.K[1, 2]:.0f}", f"{size[0]}x{size[1]}"
            wrong = f"{where}: camera '{name}' has its principal point at {at}, its clip is {films}"
            remedy = "expected it near the middle; calibrate at the size of the clip"
            raise InputError("principal-point-outside", f"{wrong}; {remedy}")
        camera = replace(camera, size=stored)
    assert camera.size is not None
    if _same_shape(camera.size, size) or _same_shape(camera.size, size, aspect):
        fitted, said = _resized(name, camera, size)
        return fitted, said + _doubt_turn(name, upright)
    if _same_shape(camera.size, stored) or _same_shape(camera.size, stored, 1 / aspect):
        fitted, said = _resized(name, camera, stored)
        text = f"calibrated on pictures as they are stored, {upright.words} as the clip's are"
        return _turned(name, fitted, upright, where), said + noted([text], name)
    (width, height), (clip_width, clip_height) = camera.size, size
    wrong = (
        f"{where}: camera '{name}' is calibrated at {width}x{height}, its clip is {clip_width}x{clip_height}"
    )
    why = "a cropped clip needs a calibration of its own"
    if _same_shape(camera.size, (clip_height, clip_width)):
        why = "one is turned, and the clip does not say how: calibrate on pictures turned like the clip's"
    expected = "expected the same size, or all of the picture made larger or smaller"
    raise InputError("picture-size-wrong", f"{wrong}; {expected}; {why}")


def _off_middle(camera: FoundCamera, size: tuple[int, int]) -> float:
    return float(np.abs(camera.K[:2, 2] / size - 0.5).max())


def _same_shape(own: tuple[int, int], size: tuple[int, int], pixel_aspect: float = 1.0) -> bool:
    """Whether a picture is another one made larger or smaller; with square pixels where the other has none."""
    if pixel_aspect == 1:
        return own[0] * size[1] == own[1] * size[0]
    return abs(own[0] * size[1] / (own[1] * size[0] * pixel_aspect) - 1) < SAME_ASPECT


def _resized(name: str, camera: FoundCamera, size: tuple[int, int]) -> tuple[FoundCamera, list[Measure]]:
    assert camera.size is not None
    if camera.size == size:
        return camera, []
    across, down = size[0] / camera.size[0], size[1] / camera.size[1]
    by = f"{across:g}" if abs(across - down) < 1e-6 else f"{across:g} and {down:g}"
    text = (
        f"calibrated at {camera.size[0]}x{camera.size[1]}, scaled by {by} to the clip's {size[0]}x{size[1]}"
    )
    return replace(camera, K=np.diag([across, down, 1.0]) @ camera.K, size=size), noted([text], name)


def _turned(name: str, camera: FoundCamera, upright: Upright, where: str) -> FoundCamera:
    """A camera of stored pictures as one of upright pictures: lens and pose."""
    assert camera.size is not None
    lens = Intrinsics(*camera.size, camera.K, camera.distortion, None, camera.model).turned(upright)
    pose = camera.cam_from_world
    if pose is not None:
        if upright.mirrored:
            wrong = f"{where}: camera '{name}' is calibrated on pictures that its clip says are mirrored"
            raise InputError("picture-mirrored", f"{wrong}; calibrate on pictures as they are seen")
        turn = np.eye(3)
        turn[:2, :2] = upright.matrix
        pose = turn @ pose
    return FoundCamera(lens.K, lens.distortion, lens.model, (lens.width, lens.height), pose)


def _doubt_turn(name: str, upright: Upright) -> list[Measure]:
    """Of a clip whose turn leaves its size, nothing tells whether a calibration is of its pictures before or after."""
    if upright.nothing or upright.quarters % 2:
        return []
    text = f"of upright pictures; the clip's are {upright.words} as its file says"
    return [Measure("given-assumed", text, name, "turned")]


def _scale(
    found: FoundCalibration,
    cameras: Mapping[str, FoundCamera],
    names: list[str],
    unit: str | None,
    known_distance_m: float | None,
) -> tuple[Scale, list[Measure]]:
    """Metres a unit of the file (as `factor`), and what was assumed about it."""
    centres = {name: -c.cam_from_world[:, :3].T @ c.cam_from_world[:, 3] for name, c in cameras.items()}  # type: ignore
    apart = max((float(np.linalg.norm(a - b)) for a, b in combinations(centres.values(), 2)), default=0.0)
    if unit is not None:
        return Scale(True, f"given calibration ({found.format}, {unit})", METRES[unit], None), []
    if found.unit in METRES:
        scale = Scale(True, f"given calibration ({found.format}, {found.unit})", METRES[found.unit], None)
        if apart * scale.factor <= LARGEST_RIG_M:
            return scale, []
        text = f"{found.unit}, by the rule of the format: the cameras are up to {apart * scale.factor:.4g} m apart"
        return scale, [Measure("given-assumed", text, "unit", "rule")]
    if known_distance_m is not None and len(names) > 1:
        first, second = names[:2]
        distance = float(np.linalg.norm(centres[first] - centres[second]))
        if distance > 0:
            source = f"known distance from {first} to {second}"
            return Scale(True, source, known_distance_m / distance, None), []
    if found.unit == "arbitrary" or apart == 0:
        return ARBITRARY, []
    guess = "mm" if apart > LARGEST_RIG_M else "m"
    text = f"taken as {guess}: the cameras are up to {apart * METRES[guess]:.3g} m apart"
    scale = Scale(True, f"given calibration ({found.format}, taken as {guess})", METRES[guess], None)
    return scale, [Measure("given-assumed", text, "unit", "unit", {"format": found.format})]


def _check_plausible(name: str, camera: FoundCamera, size: tuple[int, int], where: str) -> None:
    """Refuse what no camera has: a number that was damaged, or is in another unit."""
    longer, focal = max(size), camera.K[[0, 1], [0, 1]]
    wrong, pose = None, camera.cam_from_world
    if not (focal.min() >= LEAST_FOCAL * longer and focal.max() <= MOST_FOCAL * longer):
        wrong = f"focal lengths {focal[0]:g} and {focal[1]:g} px of pictures of {size[0]}x{size[1]}"
    elif np.abs(camera.K[:2, 2] / size - 0.5).max() > FARTHEST_CENTRE:
        wrong = f"its principal point at {camera.K[0, 2]:g}, {camera.K[1, 2]:g} px, far outside of {size[0]}x{size[1]}"
    elif np.abs(camera.distortion).max() > MOST_DISTORTION:
        wrong = f"distortion {camera.distortion.tolist()}"
    elif pose is not None and np.abs(pose[:, 3]).max() > FARTHEST:
        wrong = f"the translation {pose[:, 3].tolist()}"
    if wrong is not None:
        text = f"{where}: camera '{name}' has {wrong}; expected what a camera can have; calibrate it again"
        raise InputError("camera-implausible", text)


def _check_apart(cameras: Mapping[str, RigCamera], where: str) -> None:
    for (a, first), (b, second) in combinations(cameras.items(), 2):
        if np.array_equal(first.camera.cam_from_world, second.camera.cam_from_world):
            wrong = f"{where}: cameras '{a}' and '{b}' have the same pose; expected a pose each"
            raise InputError("poses-equal", f"{wrong}; calibrate the rig, not only the lenses")
