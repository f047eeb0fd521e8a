"""Stage `static_poses`: where the sweep's pictures were taken, and whether that can be trusted."""

from pathlib import Path
from typing import Any

from PIL import Image

from devrf.calibration.board import find_board
from devrf.calibration.board_intrinsics import BoardCalibration, calibrate_intrinsics
from devrf.calibration.static_poses import SweepModel, device_groups, recover_static_poses
from devrf.capture.frames import SWEEP, FrameSet
from devrf.pipelines.board_spec import board_spec
from devrf.pipelines.health import HealthRow, note, row
from devrf.pipelines.stage import StageContext

LISTED = 6  # names in a message
FOCAL_REMEDY = (
    "Zoom, stabilisation or a wrong EXIF focal length: film the sweep at one fixed zoom without "
    "stabilisation, or film a board with the same settings (capture.board.clips.static)."
)


def run(context: StageContext) -> None:
    """Write `static_poses.json`, `colmap/`, `points.npz` and `colmap.log`."""
    ingest = context.run_dir / "ingest"
    frames = FrameSet.read(ingest)
    sweep = frames.cameras[SWEEP]
    files = [frame.file for frame in sweep.used if frame.file is not None]
    folder = ingest / "frames"
    sizes = {f.removeprefix("frames/"): _size(ingest / f) for f in files}
    board = _board(context, frames)
    known = None if board is None else board.intrinsics
    model = recover_static_poses(
        folder,
        device_groups(sizes, sweep.exif_focal_px, known),
        context.out,
        mapper=context.config.calibration.static_poses.mapper,
        ordered=sweep.fps_mean is not None,
        progress=context.progress,
    )
    context.health.extend(health(model, sweep.exif_focal_px, board))


def _size(file: Path) -> tuple[int, int]:
    with Image.open(file) as picture:
        return picture.size


def _board(context: StageContext, frames: FrameSet) -> BoardCalibration | None:
    """Intrinsics of the sweep's device from its board clip, where there is one."""
    clip = frames.cameras.get(f"board_{SWEEP}")
    spec = board_spec(context.config)
    if clip is None or spec is None:
        return None
    ingest = context.run_dir / "ingest"
    files = [ingest / frame.file for frame in clip.used if frame.file is not None]
    views, settled = find_board(f"board_{SWEEP} ({clip.source})", files, spec, context.progress)
    return calibrate_intrinsics(SWEEP, views, settled, (clip.width, clip.height))


def health(model: SweepModel, exif_focal_px: float | None, board: BoardCalibration | None) -> list[HealthRow]:
    """Rows about how much was registered and how well it is fixed."""
    r = model.report
    lost: list[str] = r["unregistered"]
    fewest = min(r["points_per_image"].values(), default=0)
    rows = [
        row(
            "registered share of the sweep",
            r["registered"] / r["given"],
            "",
            warn=0.8,
            fail=0.4,
            remedy=f"{r['registered']} of {r['given']} pictures; missing: {_some(lost)}. A small model can "
            "look perfect: film with 70 % overlap between pictures, walk sideways, and show texture.",
        ),
        row(
            "mean reprojection error",
            r["mean_reprojection_px"],
            "px",
            warn=1.0,
            fail=2.0,
            low_is_bad=False,
            remedy="Something moved during the sweep, or the lens changed: keep the scene at "
            "rest, lock focus and zoom.",
        ),
        row(
            "mean track length",
            r["mean_track_length"],
            "pictures",
            warn=3.0,
            remedy="Points are seen in too few pictures: more overlap between neighbouring pictures.",
        ),
        row(
            "points of the poorest picture",
            fewest,
            "",
            warn=100,
            fail=30,
            remedy=f"Weak texture in {_some([n for n, p in r['points_per_image'].items() if p < 100])}: "
            "keep textured things in view, or add some for the sweep.",
        ),
        row(
            "median triangulation angle",
            r["median_triangulation_angle_deg"],
            "deg",
            warn=3.0,
            fail=1.5,
            remedy="The camera turned more than it moved: walk sideways around the scene.",
        ),
    ]
    if len(r["models"]) > 1:
        joined = "; ".join(f"{len(m)}: {_some(m)}" for m in r["other_models"])
        rows.append(
            note(
                "one model",
                f"{len(r['models'])} models: {', '.join(map(str, r['models']))} pictures",
                verdict="warn",
                remedy=f"The largest is used; apart from it stand {joined}. Film pictures that join them.",
            )
        )
    rows += _focal(model, exif_focal_px, board)
    rows.append(note("mapper", str(r["mapper"])))
    return rows


def _focal(model: SweepModel, exif_focal_px: float | None, board: BoardCalibration | None) -> list[HealthRow]:
    found = {c["K"][0][0]: c for c in model.report["cameras"].values()}
    focal = next(iter(found))
    rows: list[HealthRow] = []
    for source, start in (("EXIF", exif_focal_px), ("the board", board and board.intrinsics.K[0, 0])):
        if start:
            rows.append(
                row(
                    f"focal length against {source}",
                    100 * abs(focal / start - 1),
                    "%",
                    warn=5.0,
                    fail=15.0 if source == "the board" else None,
                    low_is_bad=False,
                    remedy=FOCAL_REMEDY,
                )
            )
    if board is not None:
        rows += board_rows(SWEEP, board)
    return rows


def board_rows(name: str, board: BoardCalibration) -> list[HealthRow]:
    """Rows about one camera's board calibration."""
    dropped = f" Dropped views: {_some([str(n) for n in board.dropped])}." if board.dropped else ""
    return [
        row(
            f"board error of {name}",
            board.rms_px,
            "px",
            warn=1.0,
            fail=3.0,
            low_is_bad=False,
            remedy=f"The board does not fit: check squares, use a flat print, avoid motion blur.{dropped}",
        ),
        row(
            f"board views of {name}",
            board.views,
            "",
            warn=10,
            remedy=f"Few views leave the principal point unsure: film the board longer.{dropped}",
        ),
        row(
            f"tilted board views of {name}",
            board.tilted_views,
            "",
            warn=5,
            remedy="Frontal views leave the focal length unsure by 1 %: tilt the board by 20 to 45 degrees.",
        ),
        row(
            f"picture covered by board corners, {name}",
            board.coverage,
            "",
            warn=0.5,
            remedy="Distortion at the edges is a guess: hold the board into every corner of the picture.",
        ),
    ]


def _some(names: list[Any]) -> str:
    more = f" and {len(names) - LISTED} more" if len(names) > LISTED else ""
    return (", ".join(str(n) for n in names[:LISTED]) + more) or "none"
