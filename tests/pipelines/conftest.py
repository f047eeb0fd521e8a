"""What several tests of the pipeline share."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.pipelines.small_stages import SCENE


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder for the small stages: scene.yaml and its two files."""
    (tmp_path / "static.mp4").write_bytes(b"sweep")
    (tmp_path / "cam0.mp4").write_bytes(b"clip")
    (tmp_path / "scene.yaml").write_text(SCENE)
    return tmp_path


@pytest.fixture(scope="session")
def textures() -> Callable[[int], np.ndarray]:
    """`textures(seed)`: a picture 640x480 (RGB) in which every place looks different, from near and from far."""

    def draw(seed: int) -> np.ndarray:
        rng = np.random.default_rng(seed)
        picture = np.zeros((480, 640, 3))
        for cells in (6, 18, 50, 140):
            picture += cv2.resize(rng.random((cells, cells, 3)), (640, 480), interpolation=cv2.INTER_CUBIC)
        picture -= picture.min()
        return (255 * picture / picture.max()).astype(np.uint8)

    return draw
