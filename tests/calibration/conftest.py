"""A small scene whose pictures are drawn, and which can be made to go wrong in every way a sweep does."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest

from devrf.calibration.intrinsics import from_vector
from devrf.calibration.sweep.devices import device_groups
from devrf.calibration.sweep.static_poses import (
    DEFAULT_OPTIONS,
    SweepModel,
    SweepOptions,
    SweepPictures,
    recover_static_poses,
)
from devrf.capture.exif import Exif, Place
from devrf.capture.view_axes import look_at

SIZE = (320, 240)
FOCAL = 300.0
VIEWS = 9
DOWN = (0.0, 0.0, -1.0)  # what is up where z points down

Path3 = Callable[[float], tuple[np.ndarray, np.ndarray]]
Draw = Callable[[np.ndarray, int], np.ndarray]


def around(angle: float) -> tuple[np.ndarray, np.ndarray]:
    """Camera centre and what it looks at: an arc before the corner."""
    centre = np.array([4.2 * np.cos(angle), 4.2 * np.sin(angle), -1.5 + 0.5 * np.sin(5 * angle)])
    return centre, np.array([0.5, 0.5, -1.5])


def untouched(picture: np.ndarray, n: int) -> np.ndarray:
    return picture


@dataclass(frozen=True)
class Corner:
    """Pictures of two textured walls that meet at right angles.

    Attributes:
        folder: Pictures.
        truth: True world_from_cam [4, 4] by name.
        exif: Tags by name.
    """

    folder: Path
    truth: dict[str, np.ndarray]
    exif: dict[str, Exif]

    def recover(
        self,
        out: Path,
        options: SweepOptions = DEFAULT_OPTIONS,
        masks: Path | None = None,
        places: Mapping[str, Place | None] | None = None,
    ) -> SweepModel:
        """Structure from motion as the stage does it."""
        out.mkdir(parents=True, exist_ok=True)
        groups = device_groups(dict.fromkeys(self.truth, SIZE), self.exif, None)
        sweep = SweepPictures(self.folder, groups, masks=masks, places=places or {})
        return recover_static_poses(sweep, out, options)


def texture(rng: np.random.Generator, side: int) -> np.ndarray:
    """Blobs of many sizes: what SIFT likes."""
    picture = np.full((side, side), 128, dtype=np.uint8)
    for _ in range(900):
        centre = tuple(int(x) for x in rng.integers(0, side, 2))
        cv2.circle(picture, centre, int(rng.integers(3, 18)), int(rng.integers(0, 256)), -1)
    return cv2.GaussianBlur(picture, (0, 0), 1.0)


def draw_corner(
    folder: Path,
    path: Path3 = around,
    walls: int = 2,
    draw: Draw = untouched,
    focal_px: Callable[[int], float] = lambda n: FOCAL,
    exif_focal_px: float | None = FOCAL,
    views: int = VIEWS,
) -> Corner:
    """Draw the pictures; `draw` changes each, `focal_px` is the true focal length of each."""
    rng = np.random.default_rng(0)
    textures = [texture(rng, 900) for _ in range(2)]
    corners = [  # of each wall, metres: the walls stand at right angles along z
        np.array([[0, 0, 0], [3, 0, 0], [3, 0, -3], [0, 0, -3.0]]),
        np.array([[0, 0, 0], [0, 3, 0], [0, 3, -3], [0, 0, -3.0]]),
    ]
    truth: dict[str, np.ndarray] = {}
    (folder / "static").mkdir(parents=True, exist_ok=True)
    for n, angle in enumerate(np.linspace(0.15, 1.2, views)):
        f = focal_px(n)
        k = from_vector(*SIZE, np.array([f, f, SIZE[0] / 2, SIZE[1] / 2, 0, 0, 0, 0, 0]))
        centre, target = path(float(angle))
        camera = k.at(look_at(centre, target, DOWN))
        picture = np.full(SIZE[::-1], 90, dtype=np.uint8)
        for wall, corner in list(zip(textures, corners, strict=True))[:walls]:
            source = np.array([[0, 0], [899, 0], [899, 899], [0, 899]], dtype=np.float32)
            H = cv2.getPerspectiveTransform(source, (camera.project(corner) - 0.5).astype(np.float32))
            drawn = cv2.warpPerspective(wall, H, SIZE, flags=cv2.INTER_AREA)
            inside = cv2.warpPerspective(np.full_like(wall, 255), H, SIZE) > 127
            picture[inside] = drawn[inside]
        name = f"static/{n:06d}.png"
        cv2.imwrite(str(folder / name), draw(picture, n))
        truth[name] = camera.world_from_cam
    exif = {} if exif_focal_px is None else dict.fromkeys(truth, Exif("camera", exif_focal_px))
    return Corner(folder, truth, exif)


@dataclass(frozen=True)
class Recovered:
    """A drawn corner and what was recovered of it."""

    corner: Corner
    out: Path
    model: SweepModel


@pytest.fixture(scope="package")
def corner(tmp_path_factory: pytest.TempPathFactory) -> Recovered:
    """The healthy corner, recovered once."""
    drawn, out = draw_corner(tmp_path_factory.mktemp("corner")), tmp_path_factory.mktemp("recovered")
    return Recovered(drawn, out, drawn.recover(out))


@pytest.fixture(scope="session")
def draw() -> Callable[..., Corner]:
    """`draw_corner`: tests draw a corner that has gone wrong."""
    return draw_corner
