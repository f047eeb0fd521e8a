"""The published DeVRF layout of forward-facing scenes: `static/` in LLFF's layout and `dynamic_<n>views/`.

`dynamic_<n>views/poses.npy` and `bds.npy` are what the published loader makes of `static/`: rows [R | t | height,
width, focal] with OpenGL's axes (right, up, back), scaled by 1 / (0.75 nearest bound), recentred on the mean
pose. Their last n rows are the fixed cameras, as are the last n pictures of `static/`.
`view<k>/` holds the k-th camera's frames, evenly spaced in time; the last view is the test view.
`view<k>/images_flow/NNN_bwd.npz` (`images_4_flow` for `images_4`) is the flow of its frame NNN.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from devrf.capture.camera import Camera
from devrf.capture.formats.llff import (
    FACTORS,
    check_bounds,
    largest_pictures,
    llff_frames,
    pictures_in,
    pinhole,
    read_rows,
)
from devrf.capture.formats.parts.assembly import Pictures, forward_frame
from devrf.capture.formats.parts.files import Header, read_header
from devrf.capture.formats.parts.flow_files import flow_name, with_flow_files
from devrf.capture.formats.parts.opengl import FLIP_YZ
from devrf.capture.scene import PosedFrame
from devrf.capture.system.errors import CaptureError

LARGEST_MISS = 0.1  # between a fixed camera's two poses; the nearest content is at 4/3
LARGEST_TURN_DEG = 10.0


def read_devrf_forward(folder: Path, moving: Path, notes: list[str]) -> Pictures:
    """A forward-facing scene at rest and in motion."""
    rows = read_rows(folder / "static" / "poses_bounds.npy", 17)
    static, bounds = llff_frames(folder / "static", rows, notes)
    views = [p for p in sorted(moving.glob("view*"), key=_number) if _number(p) > 0]
    if len(views) < 2 or [_number(p) for p in views] != list(range(1, len(views) + 1)):
        found = ", ".join(p.name for p in views) or "none"
        text = f"{moving}: expected the folders view1, view2, ... (two or more), found {found}"
        raise CaptureError("folder-missing", text)
    poses = read_rows(moving / "poses.npy", 15)
    check_bounds(read_rows(moving / "bds.npy", 2), moving / "bds.npy")
    for name, count in (("poses.npy", len(poses)), ("static pictures", len(static))):
        if count < len(views):
            wrong = f"{moving}: {count} {name} for {len(views)} views"
            text = f"{wrong}; expected {len(views)} or more: the fixed cameras are the last {len(views)}"
            raise CaptureError("count-mismatch", text)
    box_from_world = forward_frame([f.camera for f in static], bounds)
    dynamic: list[PosedFrame] = []
    for n, view in enumerate(views):
        row = len(poses) - len(views) + n
        frames = _view(view, poses[row].reshape(3, 5), f"{moving / 'poses.npy'}: row {row} ({view.name})")
        at_rest = static[len(static) - len(views) + n].camera.moved(box_from_world)
        _check_same_place(frames[0].camera, at_rest, moving / "poses.npy", view.name)
        test = n == len(views) - 1
        dynamic += _finished(frames, view, np.linalg.inv(box_from_world), test)
    return Pictures(static, tuple(dynamic), keep=len(views), bounds=bounds)


def _view(view: Path, matrix: np.ndarray, where: str) -> list[PosedFrame]:
    """A view's frames; their cameras are in the frame of `poses.npy`, with our axes."""
    headers = [read_header(path) for path in largest_pictures(view, None)]
    last = max(len(headers) - 1, 1)
    cameras: dict[tuple[int, int], Camera] = {}

    def camera(header: Header) -> Camera:
        size = (header.width, header.height)
        if size not in cameras:
            seen = pinhole(matrix[:, :4], matrix[:, 4], header, where)
            cameras[size] = seen.moved(FLIP_YZ)  # the mean camera looks along +z
        return cameras[size]

    return [
        PosedFrame(header.path, camera(header), view.name, n, n / last, n / last, "train")
        for n, header in enumerate(headers)
    ]


def _finished(
    frames: list[PosedFrame], view: Path, world_from_box: np.ndarray, test: bool
) -> tuple[PosedFrame, ...]:
    """The frames with their cameras in the world of `static/`, and their flow."""
    out = tuple(
        replace(f, camera=f.camera.moved(world_from_box), split="test" if test else "train") for f in frames
    )
    if test:
        return out
    chosen = out[0].path.parent.name
    for factor in sorted(FACTORS, key=lambda factor: f"images{factor}" != chosen):
        folder = view / f"images{factor}_flow"
        if folder.is_dir():
            return with_flow_files(
                out, lambda n, folder=folder: folder / flow_name(n), _size(view, factor, out[0])
            )
    return out


def _size(view: Path, factor: str, frame: PosedFrame) -> tuple[int, int]:
    """(width, height) of the pictures that a folder of flow belongs to."""
    beside = pictures_in(view / f"images{factor}")
    if beside:
        header = read_header(beside[0])
        return header.width, header.height
    full = int(frame.path.parent.name[7:] or 1)
    ratio = full / int(factor[1:] or 1)
    return round(frame.camera.width * ratio), round(frame.camera.height * ratio)


def _check_same_place(camera: Camera, static: Camera, path: Path, view: str) -> None:
    """A fixed camera's pose must be that of its picture at rest."""
    miss = float(np.linalg.norm(camera.centre - static.centre))
    cosine = (np.trace(camera.cam_from_world[:, :3] @ static.cam_from_world[:, :3].T) - 1) / 2
    turn = float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
    if miss > LARGEST_MISS or turn > LARGEST_TURN_DEG:
        wrong = f"{path}: {view} is {miss:.3g} units and {turn:.1f} degrees from its picture at rest"
        remedy = (
            "the last pictures of static/ must be the fixed cameras, in order, and poses.npy must be recentred and "
            "scaled by 1 / (0.75 nearest bound), as the published loader does"
        )
        raise CaptureError("pose-differs", f"{wrong}, expected the same pose; {remedy}")


def _number(path: Path) -> int:
    digits = path.name.removeprefix("view")
    return int(digits) if digits.isdigit() and path.is_dir() else 0
