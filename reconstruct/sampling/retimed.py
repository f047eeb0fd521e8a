"""The scene with the times that its motion was learned with."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from devrf.capture.scene import PosedFrame, Scene

BEYOND = 1e-3  # of all modelled time, that a picture may lie outside of it


def as_trained(scene: Scene, metrics: Mapping[str, Any]) -> Scene:
    """Move the clocks that training moved. Those of test cameras stay as they were calibrated.

    Args:
        scene: As `scene` left it.
        metrics: What stage `deformation` measured; nothing of offsets in there: all clocks stay.
    """
    return retimed(scene, metrics.get("clock_offsets_s", {}))


def retimed(scene: Scene, offsets_s: Mapping[str, float]) -> Scene:
    """The scene with pictures of some cameras taken so much later, without training pictures beyond what is modelled.

    Test pictures beyond it are shown at its end: which of them are scored does not depend on clocks.
    """
    span_s = scene.t1_s - scene.t0_s

    def moved(frame: PosedFrame) -> PosedFrame | None:
        offset_s = offsets_s.get(frame.camera_name, 0.0)
        if offset_s == 0 or frame.time_s is None:
            return frame
        time_s = frame.time_s + offset_s
        time = (time_s - scene.t0_s) / span_s
        if frame.split != "test" and not -BEYOND <= time <= 1 + BEYOND:
            return None
        return replace(frame, time_s=time_s, time=min(1.0, max(0.0, time)))

    return replace(scene, dynamic=tuple(f for f in map(moved, scene.dynamic) if f is not None))
