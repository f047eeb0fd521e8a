"""Of which cameras that are not trained on stage `deformation` learns the clock."""

import pytest

from devrf.capture.scene import Scene
from devrf.pipelines.stages.deformation import unknown_test_clocks


@pytest.mark.parametrize(
    ("std_s", "unknown"), [(0.03, ["witness"]), (None, ["witness"]), (0.0002, []), (0.0, [])]
)
def test_only_clocks_that_are_not_known_are_learned(
    odd_scene: Scene, std_s: float | None, unknown: list[str]
) -> None:
    clocks = {
        name: {"offset_s": 0.0, "std_s": std_s} for name in ("cam0", "cam1", "witness", "films nothing")
    }
    assert unknown_test_clocks(odd_scene, clocks) == unknown
