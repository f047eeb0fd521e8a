"""The report's calibration section: the sweep's poses and the rig with their doubts."""

from devrf.pipelines.report.html import absent, number, section, table, text
from devrf.pipelines.report.run import RunFolder, at

POSES, RIG, METRICS = "static_poses/static_poses.json", "rig/rig.json", "evaluate/metrics.json"
INTRINSICS = {"board": "board", "self": "the sweep", "given": "given"}
TRUTH = (
    ("pose_rotation_deg", "sweep, rotation", "°", 3),
    ("pose_position_m", "sweep, position", "m", 4),
    ("rig_rotation_deg", "fixed cameras, rotation", "°", 3),
    ("rig_position_m", "fixed cameras, position", "m", 4),
    ("rig_position_percent", "fixed cameras, position over distance to the scene", "%", 2),
    ("sync_ms", "clocks", "ms", 3),
)


def rig_section(run: RunFolder) -> str:
    """Structure from motion of the sweep, fixed cameras, scale, and the truth where there is one."""
    lead = (
        "How well the cameras are known. Standard deviations are the solver's own; "
        "a truth exists only for simulated sessions."
    )
    body = _sweep(run) + _rig(run) + _truth(run)
    return section("rig", "Poses and rig", lead, body)


def _sweep(run: RunFolder) -> str:
    poses = run.object(POSES)
    if not poses:
        return f"<h3>Sweep</h3>{absent(run.why_absent('static_poses'))}"
    models = poses.get("models") or []
    rows = [
        [
            f"{number(poses.get('registered'), '', 0, file=POSES, key='registered')} of "
            f"{number(poses.get('given'), '', 0, file=POSES, key='given')}",
            number(poses.get("mean_reprojection_px"), "px", 2, file=POSES, key="mean_reprojection_px"),
            number(poses.get("mean_track_length"), "", 1, file=POSES, key="mean_track_length"),
            number(
                poses.get("median_triangulation_angle_deg"),
                "°",
                1,
                file=POSES,
                key="median_triangulation_angle_deg",
            ),
            number(poses.get("points"), "", 0, file=POSES, key="points"),
            text(f"{poses.get('mapper', '')}, {len(models)} model{'s' if len(models) != 1 else ''}"),
        ]
    ]
    head = ("registered", "reprojection error", "track length", "triangulation angle", "points", "mapper")
    lost = [str(f) for f in poses.get("unregistered") or []]
    lost_line = f"<p>Not registered: {text(', '.join(lost))}</p>" if lost else ""
    return f"<h3>Sweep</h3>{table(head, rows, source=POSES, numeric=(0, 1, 2, 3, 4))}{lost_line}"


def _rig(run: RunFolder) -> str:
    rig = run.object(RIG)
    cameras = run.cameras(RIG)
    if not cameras:
        return f"<h3>Fixed cameras</h3>{absent(run.why_absent('rig'))}"
    metric = bool(at(rig, "scale.metric"))
    unit = "m" if metric else "units"
    rows = []
    for name, camera in cameras.items():
        key = f"cameras.{name}"
        focal = camera["K"][0][0] if camera.get("K") else None
        rows.append(
            [
                f"<strong>{text(name)}</strong>",
                f"{text(camera.get('width', '?'))} × {text(camera.get('height', '?'))}",
                number(focal, "px", 1, file=RIG, key=f"{key}.K.0.0"),
                text(INTRINSICS.get(str(camera.get("intrinsics")), camera.get("intrinsics") or "")),
                number(camera.get("inliers"), "", 0, file=RIG, key=f"{key}.inliers"),
                number(camera.get("rms_px"), "px", 2, file=RIG, key=f"{key}.rms_px"),
                number(at(camera, "std.rotation_deg"), "°", 3, file=RIG, key=f"{key}.std.rotation_deg"),
                number(at(camera, "std.position"), unit, 4, file=RIG, key=f"{key}.std.position"),
            ]
        )
    scale = rig.get("scale") or {}
    words = "Metric scale" if metric else "Arbitrary scale"
    spread = number(scale.get("std"), "%", 2, file=RIG, key="scale.std", scale=100.0)
    spread = f"; standard deviation {spread}" if scale.get("std") is not None else ""
    scale_line = f"{words}; source: {text(scale.get('source', 'not said'))}{spread}"
    head = (
        "camera",
        "size, px",
        "focal length",
        "from",
        "points",
        "error",
        "std. dev., rotation",
        "std. dev., position",
    )
    body = table(head, rows, source=RIG, numeric=(1, 2, 4, 5, 6, 7))
    return f"<h3>Fixed cameras</h3>{body}<p>{scale_line}.</p>"


def _truth(run: RunFolder) -> str:
    truth = at(run.object(METRICS), "truth")
    if not isinstance(truth, dict):
        return ""
    rows = [
        [
            text(label),
            number(truth.get(key), unit, digits, file=METRICS, key=f"truth.{key}"),
            number(truth.get(f"{key}_median"), unit, digits, file=METRICS, key=f"truth.{key}_median"),
        ]
        for key, label, unit, digits in TRUTH
        if key in truth
    ]
    head = ("error of", "largest", "median")
    return "<h3>Against the truth</h3>" + table(head, rows, source=METRICS, numeric=(1, 2), narrow=True)
