"""From what a reader found to a `Scene`: held-out pictures, a stride in time, and the box.

A data set says nothing of a box. Cameras around a subject get a loose cube at the focus of their view axes.
A forward-facing set has bounds, and gets LLFF's frame (Mildenhall et al., SIGGRAPH 2019, and its loaders):
recentred on the mean camera, scaled so that the nearest content is at 4/3 and the near plane at z = 1.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from devrf.capture.bursts import bursts, held_out
from devrf.capture.camera import Camera
from devrf.capture.scene import Background, PosedFrame, Scene, SparsePoints, plain_colour
from devrf.capture.system.amounts import some
from devrf.capture.system.errors import CaptureError
from devrf.capture.view_axes import closest_point

NEAR_PLANE = 0.75  # of the nearest bound (LLFF's loaders); becomes 1
FORWARD_MEAN = 0.85  # length of the mean view direction; near 1 all cameras look the same way
TIME_TOLERANCE = 1e-6  # times are rounded in files
SIDE_MARGIN = 1.05  # of the box around a forward-facing set, to the sides


@dataclass(frozen=True)
class Pictures:
    """What a reader found.

    Attributes:
        static: Pictures of the scene at rest, in order.
        dynamic: Pictures of the scene in motion.
        has_split: Whether the set itself says which pictures at rest are test pictures.
        keep: The last n pictures at rest are never held out.
        points: Sparse points, where the set has them.
        bounds: Nearest and farthest content of each picture at rest, world units: a forward-facing set.
        own: What an export of ours said of box, times and background (`scene_entry`), and in which file.
        behind: Background of a forward-facing set where nobody says and the pictures carry no alpha.
    """

    static: tuple[PosedFrame, ...]
    dynamic: tuple[PosedFrame, ...] = ()
    has_split: bool = False
    keep: int = 0
    points: SparsePoints | None = None
    bounds: Float[np.ndarray, "static 2"] | None = None
    own: tuple[Any, Path] | None = None
    behind: Background = "shell"


def box_around(pictures: Pictures, background: Background) -> Scene:
    """A loose box around what all cameras look at: centred at the focus of the view axes."""
    cameras = [f.camera for f in pictures.static]
    axes = np.stack([c.cam_from_world[2, :3] for c in cameras])
    centres = np.stack([c.centre for c in cameras])
    focus = closest_point(centres, axes)
    distance = np.linalg.norm(centres - focus, axis=1)
    half_angle = np.array([max(c.width / c.K[0, 0], c.height / c.K[1, 1]) / 2 for c in cameras])
    half_side = float((distance * half_angle).max())
    box_from_world = np.eye(4)
    box_from_world[:3] = np.column_stack([np.eye(3), -focus]) / half_side
    reach = np.sqrt(3) * half_side
    return _scene(
        pictures,
        background,
        box_from_world=box_from_world,
        aabb=np.array([[-1.0] * 3, [1.0] * 3]),
        near=max(float(distance.min() - reach), 0.02 * half_side) / half_side,
        far=float(distance.max() + reach) / half_side,
        kind="forward" if faces_forward(cameras) else "inward",
    )


def frustum_box(pictures: Pictures, background: Background) -> Scene:
    """A forward-facing set in LLFF's frame: the mean camera at the origin, near plane at z = 1."""
    assert pictures.bounds is not None
    cameras = [f.camera for f in pictures.static]
    box_from_world = forward_frame(cameras, pictures.bounds)
    near, far = (
        float(b) for b in _scale(pictures.bounds) * np.array([pictures.bounds.min(), pictures.bounds.max()])
    )
    tangents = np.array([[c.width / 2 / c.K[0, 0], c.height / 2 / c.K[1, 1]] for c in cameras])
    tan_x, tan_y = tangents.max(axis=0)
    moved = np.stack([c.moved(box_from_world).centre for c in cameras])
    side = SIDE_MARGIN * far * np.array([tan_x, tan_y]) + np.abs(moved[:, :2]).max(axis=0)
    return _scene(
        pictures,
        background,
        box_from_world=box_from_world,
        aabb=np.array([[*-side, 1.0], [*side, far]]),
        near=near,
        far=far,
        kind="forward",
        ndc=(float(tan_x), float(tan_y)),
    )


def forward_frame(cameras: Sequence[Camera], bounds: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "4 4"]:
    """The similarity [4, 4] that recentres on LLFF's mean pose and makes 0.75 of the nearest bound 1.

    The mean camera's z is the mean viewing direction, its y as near as can be to the mean down direction.
    """
    forward = np.sum([c.cam_from_world[2, :3] for c in cameras], axis=0)
    down = np.sum([c.cam_from_world[1, :3] for c in cameras], axis=0)
    z = forward / np.linalg.norm(forward)
    x = np.cross(down, z)
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z])
    centre = np.mean([c.centre for c in cameras], axis=0)
    out = np.eye(4)
    out[:3] = _scale(bounds) * np.column_stack([R, -R @ centre])
    return out


def faces_forward(cameras: Sequence[Camera]) -> bool:
    """Whether all cameras look about the same way, as LLFF's frame needs."""
    axes = np.stack([c.cam_from_world[2, :3] for c in cameras])
    return bool(np.linalg.norm(axes.mean(axis=0)) >= FORWARD_MEAN)


def is_plain(background: Background) -> bool:
    """Whether nothing is seen behind the subject."""
    return plain_colour(background) is not None


def every_nth_time(frames: tuple[PosedFrame, ...], stride: int) -> tuple[PosedFrame, ...]:
    """Every n-th time; cameras that share no times are thinned one by one. Given flow no longer fits."""
    if stride == 1:
        return frames
    times = sorted({f.time for f in frames if f.time is not None})
    longest = max(Counter(f.camera_name for f in frames).values(), default=0)
    if len(times) == longest:
        kept = set(times[::stride])
        thinned = [f for f in frames if f.time in kept]
    else:
        chosen = {
            id(f)
            for name in {f.camera_name for f in frames}
            for f in sorted((g for g in frames if g.camera_name == name), key=_time)[::stride]
        }
        thinned = [f for f in frames if id(f) in chosen]
    return tuple(replace(f, flow=None) for f in thinned)


def hold_out(
    frames: tuple[PosedFrame, ...], every: int, keep: int, notes: list[str]
) -> tuple[PosedFrame, ...]:
    """Every n-th picture becomes a test picture, near-doubles together, which is noted; the last `keep` never do."""
    last = len(frames) - keep
    doubles = bursts([f.camera for f in frames[:last]])
    if doubles:
        names = some([f"{frames[of[0]].path.name} and {len(of) - 1} more" for of in doubles])
        notes.append(
            f"{len(doubles)} bursts of pictures from one place, of {names}: each is held out whole or not at all"
        )
    held = held_out(last, every, doubles).tolist() + [False] * keep
    return tuple(replace(f, split="test") if h else f for f, h in zip(frames, held, strict=True))


def time_within(value: Any, where: str) -> float:
    """A time that must lie in [0, 1].

    Raises:
        CaptureError: It does not, or is no number.
    """
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if not (is_number and -TIME_TOLERANCE <= value <= 1 + TIME_TOLERANCE):
        text = f"{where}: time is {value!r}; expected a number in [0, 1]; divide all times by the last one"
        raise CaptureError("entry-wrong", text)
    return float(np.clip(value, 0.0, 1.0))


def check_sizes(frames: Iterable[PosedFrame]) -> None:
    """Every camera of the moving scene must keep its size.

    Raises:
        CaptureError: It does not.
    """
    first: dict[str, PosedFrame] = {}
    for frame in frames:
        other = first.setdefault(frame.camera_name, frame)
        size, expected = ((f.camera.width, f.camera.height) for f in (frame, other))
        if size != expected:
            wrong = f"{frame.path}: picture is {size[0]}x{size[1]}"
            other_is = (
                f"{other.path.name} of the same camera {frame.camera_name!r} is {expected[0]}x{expected[1]}"
            )
            raise CaptureError("picture-size-wrong", f"{wrong}, {other_is}; expected one size per camera")


def _scene(pictures: Pictures, background: Background, **box: Any) -> Scene:
    times = [f.time for f in pictures.dynamic if f.time is not None]
    t0_s, t1_s = _span(pictures.dynamic)
    return Scene(
        static=pictures.static,
        dynamic=pictures.dynamic,
        background=background,
        t0_s=t0_s,
        t1_s=t1_s,
        rest_time=min(times) if times else None,
        image_scale=1.0,
        points=pictures.points,
        **box,
    )


def _span(frames: tuple[PosedFrame, ...]) -> tuple[float, float]:
    """Seconds at the times 0 and 1, by the first and the last picture."""
    if not frames:
        return 0.0, 1.0
    first, last = min(frames, key=_time), max(frames, key=_time)
    span = _time(last) - _time(first)
    if span <= 0 or first.time_s is None or last.time_s is None:
        return 0.0, 1.0
    rate = (last.time_s - first.time_s) / span
    t0_s = first.time_s - rate * _time(first)
    return (t0_s, t0_s + rate) if rate > 0 else (0.0, 1.0)


def _time(frame: PosedFrame) -> float:
    return frame.time or 0.0


def _scale(bounds: Float[np.ndarray, "n 2"]) -> float:
    return 1.0 / (NEAR_PLANE * float(bounds.min()))
