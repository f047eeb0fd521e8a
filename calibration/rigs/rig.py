"""The rig: every fixed camera with its uncertainty, and the scale of the world it stands in. rig.json.

`cam_from_world` is in the scaled world: metres where `scale.metric`, else the sweep's arbitrary unit.
`scale.factor` takes the sweep's unit (static_poses.json) to this one. K has the centre of the top-left pixel
at (0.5, 0.5); distortion is as in `capture.camera`.
"""

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from devrf.calibration.formats.found import OTHER_NAMES
from devrf.calibration.rigs.graph import Link
from devrf.capture.camera import Camera
from devrf.capture.system.errors import InputError
from devrf.capture.system.limits import TEXT_BYTES, check_bytes


@dataclass(frozen=True)
class RigCamera:
    """One fixed camera.

    Attributes:
        camera: Calibration.
        intrinsics_source: `board`, `self` (the sweep's points) or `given`.
        rotation_std_deg, position_std: Standard deviations; None where not known.
        inliers: Points (sweep) or board corners that support it; None where not counted.
        rms_px: Reprojection error of these.
        details: More numbers for the report.
    """

    camera: Camera
    intrinsics_source: str
    rotation_std_deg: float | None = None
    position_std: float | None = None
    inliers: int | None = None
    rms_px: float | None = None
    details: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Scale:
    """How long a unit is.

    Attributes:
        metric: Whether the unit is a metre.
        source: What says so, or "arbitrary scale".
        factor: From the sweep's unit to the rig's.
        std: Relative standard deviation of the factor; None where not known.
    """

    metric: bool
    source: str
    factor: float
    std: float | None


ARBITRARY = Scale(False, "arbitrary scale", 1.0, None)


@dataclass(frozen=True)
class Rig:
    """All fixed cameras, test cameras too, and the scale.

    Attributes:
        cameras: Name -> camera.
        scale: How long a unit is.
        route: What gave the poses: `sweep`, `board` or `given`.
        graph: Which cameras that are trained on are tied together by what.
        left_out: Camera that could not be placed -> why.
    """

    cameras: dict[str, RigCamera]
    scale: Scale
    route: str = "sweep"
    graph: tuple[Link, ...] = ()
    left_out: dict[str, str] = field(default_factory=dict)


def write_rig(path: Path, rig: Rig) -> None:
    """Write rig.json."""
    cameras = {}
    for name, c in rig.cameras.items():
        cameras[name] = {
            "model": c.camera.model,
            "width": c.camera.width,
            "height": c.camera.height,
            "K": c.camera.K.tolist(),
            "distortion": c.camera.distortion.tolist(),
            "cam_from_world": c.camera.cam_from_world.tolist(),
            "std": {"rotation_deg": c.rotation_std_deg, "position": c.position_std},
            "intrinsics": c.intrinsics_source,
            "inliers": c.inliers,
            "rms_px": c.rms_px,
            **({"details": c.details} if c.details else {}),
        }
    s = rig.scale
    scale = {"metric": s.metric, "source": s.source, "factor": s.factor, "std": s.std}
    content = {"route": rig.route, "cameras": cameras, "scale": scale, "left_out": rig.left_out}
    if rig.graph:
        content["graph"] = [asdict(link) for link in rig.graph]
    path.write_text(json.dumps(content, indent=1))


def read_rig(path: Path) -> Rig:
    """Read rig.json.

    Raises:
        InputError: Not such a file; says which key is wrong.
    """
    where = ""
    try:
        check_bytes(path, TEXT_BYTES)
        data = json.loads(path.read_text(encoding="utf-8-sig"))
        cameras = {}
        for name, c in data["cameras"].items():
            where = f"camera '{name}': "
            if "distortion" not in c and (other := [key for key in OTHER_NAMES if key in c]):
                raise ValueError(f"has no distortion, but {', '.join(other)}")
            camera = Camera(
                int(c["width"]),
                int(c["height"]),
                np.array(c["K"], dtype=np.float64),
                np.array(c["cam_from_world"], dtype=np.float64)[:3],
                np.array(c.get("distortion", [0.0] * 5), dtype=np.float64),
                c.get("model", "OPENCV"),
            )
            std = c.get("std") or {}
            cameras[name] = RigCamera(
                camera,
                c.get("intrinsics", "given"),
                std.get("rotation_deg"),
                std.get("position"),
                c.get("inliers"),
                c.get("rms_px"),
                c.get("details", {}),
            )
        where = ""
        s = data.get("scale") or {}
        scale = Scale(
            bool(s.get("metric", False)),
            str(s.get("source", ARBITRARY.source)),
            float(s.get("factor", 1.0)),
            s.get("std"),
        )
        if not 0 < scale.factor < float("inf"):
            raise ValueError(f"scale.factor is {scale.factor:g}, expected a finite number above 0")
        return Rig(cameras, scale, data.get("route", "given"), left_out=dict(data.get("left_out", {})))
    except OSError as error:
        text = f"{path}: cannot be read ({error.strerror}); check calibration.rig.given"
        raise InputError("file-unreadable", text) from None
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        why = f"{where}{error}{' is missing' if isinstance(error, KeyError) else ''}"
        expected = (
            "expected cameras with width, height, K, distortion and cam_from_world, as docs/formats.md says"
        )
        raise InputError("file-damaged", f"{path}: not a rig.json ({why}); {expected}") from None
