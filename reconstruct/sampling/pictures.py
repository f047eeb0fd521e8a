"""Which of a scene's pictures are looked at: those that are trained on, by camera."""

from collections.abc import Sequence

from devrf.capture.scene import PosedFrame, Scene, by_camera


def training(frames: Sequence[PosedFrame]) -> tuple[PosedFrame, ...]:
    """The pictures that are trained on."""
    return tuple(f for f in frames if f.split == "train")


def clips(scene: Scene) -> dict[str, list[PosedFrame]]:
    """The pictures of the moving scene that are trained on, by camera, in the order of their times."""
    found = by_camera(sorted(training(scene.dynamic), key=lambda f: f.time or 0.0))
    return dict(sorted(found.items()))


def in_two(frames: Sequence[PosedFrame]) -> tuple[list[PosedFrame], list[PosedFrame]]:
    """Pictures of a camera in the order of their times: those in even and those in odd places, counted from 0."""
    ordered = sorted(frames, key=lambda f: (f.time or 0.0, f.index))
    return ordered[::2], ordered[1::2]


def stands(frames: Sequence[PosedFrame]) -> bool:
    """Whether a camera has one pose and one lens in all of these pictures."""
    return len({frame.camera.view for frame in frames}) == 1
