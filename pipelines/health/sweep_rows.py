"""What a recovered sweep measures of itself: how much was registered, how well it is fixed, which fault it shows."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from devrf.calibration.intrinsics import Intrinsics
from devrf.calibration.sweep.checks import (
    field_of_view_deg,
    fold,
    oblong,
    open_loop,
    picture_fits,
    plane_share,
    principal_point_off,
    two_zooms,
)
from devrf.calibration.sweep.static_poses import MAX_IMAGE_SIZE, SweepModel
from devrf.capture.frames import some
from devrf.capture.measure import Measure

POOR_POINTS = 100  # of a picture: named in the remedy
MOVING_SHARE = 0.1  # of a picture's textured tiles
OBLONG = 2.0  # percent by which focal lengths across and down differ beyond what the file says
CROPS = 0.95  # of the residuals, with principal points of their own: captures 0.978 to 0.996, stabilised 0.67 to 0.90
CROP_MOVES, CROP_GONE = 0.5, 3.0  # percent of the width: named, refused
ZOOM_SAYS_MORE = 1.5  # of what own principal points take off: zooms 1.9 to 3.4, stabilised films at most 1.1
FOLLOWS = ("sweep-registered", "sweep-points", "sweep-in-parts", "sweep-contradicts")
ZOOMS_APART = 0.05  # relative; a lens breathes by 1 to 3 % when it focuses
ZOOMED = 0.1  # relative: poses by one focal length are wrong
MODEL = "limits of its lens model"
WIDE_DEG = 110.0  # across; wider lenses need a fisheye's model
LINKED = 0.2  # of pictures of the same place that share points: fewer leave a loop open
EXIF_BAD = 15.0  # percent: another crop's equivalent, rather
CROP = "; is it the 35 mm equivalent of another crop?"


def sweep_measures(
    model: SweepModel,
    board: Intrinsics | None = None,
    side_px: int = MAX_IMAGE_SIZE,
    pixel_aspect: float = 1.0,
) -> Iterator[Measure]:
    """All that is asked of a recovered sweep; where no one lens took the pictures, that is the remedy of what follows.

    Args:
        board: Intrinsics by a board, where there is one.
        side_px: Longer side of the pictures in which features were looked for.
        pixel_aspect: Width of a pixel over its height, as the file says.
    """
    fits = picture_fits(model)
    adjustment = model.report["adjustment"] or {}
    zoom, crops = adjustment.get("zoom"), adjustment.get("crops")
    taken_off = 1 - crops["error"] if crops is not None else 0.0
    zoomed = zoom is not None and 1 - zoom["error"] > ZOOM_SAYS_MORE * taken_off
    moved = 100 * crops["apart"] if crops is not None and crops["error"] < CROPS and not zoomed else 0.0
    no_lens = moved > CROP_MOVES or max(oblong(c, pixel_aspect) for c in model.cameras) > OBLONG / 100
    for measure in (*_registered(model.report), *_pairs(model.report)):
        follows = no_lens and measure.code in FOLLOWS and measure.why != "left"
        yield replace(measure, why="lens") if follows else measure
    yield from _lenses(model, board, pixel_aspect)
    yield Measure("sweep-centre", moved, "from picture to picture", "moves", warn=CROP_MOVES, fail=CROP_GONE)
    yield Measure("sweep-flat", plane_share(model))
    yield Measure("sweep-rolling", fits.rows_px)
    zooms = two_zooms(model, fits, ZOOMS_APART)
    before, after = (1.0, 1.0) if zoom is None else zoom["focal_px"]
    if zoom is not None and abs(after - before) > ZOOMS_APART * before and moved <= CROP_MOVES:
        facts = {"at": zoom["from"], "before": before, "after": after}
        text = f"{before:.0f}, later {after:.0f} px"
        verdict = "fail" if abs(after - before) > ZOOMED * before else "warn"
        yield Measure("sweep-focal", text, "one for all pictures", "zoomed", facts, found=verdict)
    elif zooms is not None:
        facts = {"short": some(zooms.short), "long": some(zooms.long)}
        text = f"two groups, {100 * (zooms.ratio - 1):.0f} % apart"
        yield Measure("sweep-focal", text, "one for all pictures", "zooms", facts)
    loop = open_loop(model)
    if loop is not None and loop[0] < LINKED:
        one, other = loop[1]
        text = f"{100 * loop[0]:.0f} % of the pictures of the same place share points"
        yield Measure("sweep-in-parts", text, why="loop", facts={"one": one, "other": other})
    yield from _unfinished(model.report, side_px)


def _registered(r: dict[str, Any]) -> Iterator[Measure]:
    counts: dict[str, int] = r["points_per_image"]
    facts = {"registered": r["registered"], "given": r["given"], "missing": some(r["unregistered"])}
    yield Measure("sweep-registered", r["registered"] / r["given"], facts=facts)
    yield Measure("sweep-error", r["mean_reprojection_px"])
    poor = some([n for n, p in counts.items() if p < POOR_POINTS])
    yield Measure("sweep-points", min(counts.values(), default=0), facts={"poor": poor})
    if r["weak"]:
        text = f"{len(r['weak'])} pictures with too few were left out"
        yield Measure("sweep-points", text, why="left", facts={"weak": some(r["weak"])})
    turned = {"homographies": 100 * r["verified_pairs"]["homography_share"]}
    yield Measure("sweep-angle", r["median_triangulation_angle_deg"], facts=turned)
    lost = set(r["unregistered"])  # pictures that the largest model has too are missed by nobody
    apart = [m for m in r["other_models"] if lost.intersection(m)]
    if apart:
        parts = "; ".join(f"{len(m)}: {some(m)}" for m in apart)
        text = f"{len(r['models'])} models: {', '.join(map(str, r['models']))} pictures"
        yield Measure("sweep-in-parts", text, why="parts", facts={"parts": parts})


def _pairs(r: dict[str, Any]) -> Iterator[Measure]:
    pairs = r["verified_pairs"]
    wrong, torn = pairs["contradicting"], r["torn"]
    share = 100 * len(wrong) / max(1, pairs["strong_pairs"])
    named = some([" - ".join(pair["names"]) for pair in wrong])
    yield Measure("sweep-contradicts", share, facts={"pairs": named})
    if torn:
        named = some([" - ".join(names) for names in torn])
        yield Measure("sweep-contradicts", f"{len(torn)} of neighbours", why="torn", facts={"pairs": named})
    moving = sorted(n for n, share in pairs["moving"].items() if share > MOVING_SHARE)
    yield Measure("sweep-moving", len(moving) / max(1, r["registered"]), facts={"moving": some(moving)})
    yield Measure("sweep-overlay", 100 * pairs["watermark_share"])


def _lenses(model: SweepModel, board: Intrinsics | None, pixel_aspect: float) -> Iterator[Measure]:
    r = model.report
    found = {k: c["K"][0][0] for k, c in r["cameras"].items()}
    for start in r["start"]:
        if start["source"] == "EXIF" and start["camera_id"] is not None:
            focal = found[str(start["camera_id"])]
            percent = 100 * abs(focal / start["focal_px"] - 1)
            crop = CROP if percent > EXIF_BAD else "."
            facts = {"exif_px": start["focal_px"], "found_px": focal, "crop": crop}
            about = f"against EXIF of {start['label']}"
            yield Measure("sweep-focal", percent, about, "exif", facts, refuses=False)
    if board is not None:  # no picture of that lens may be in the model
        ids = [s["camera_id"] for s in r["start"] if s["source"] == "board" and s["camera_id"] is not None]
        focals = [found[str(n)] for n in ids]
        off = 100 * abs(focals[0] / board.K[0, 0] - 1) if focals else None
        yield Measure("sweep-focal", off, "against the board")
    lenses = list({camera.lens: camera for camera in model.cameras}.values())
    wide = max((field_of_view_deg(c) for c in lenses if c.model == "OPENCV"), default=0.0)
    if wide > WIDE_DEG:
        yield Measure("sweep-focal", f"{wide:.0f} degrees wide", MODEL, "wide")
    most = max(lenses, key=lambda camera: oblong(camera, pixel_aspect))
    facts = {"fx": most.K[0, 0], "fy": most.K[1, 1], "aspect": pixel_aspect}
    percent = 100 * oblong(most, pixel_aspect)
    yield Measure(
        "sweep-focal", percent, "horizontal (fx) against vertical (fy)", "oblong", facts, warn=OBLONG
    )
    folds = min(fold(c) for c in lenses)
    if folds < 1:
        yield Measure("sweep-focal", f"one-to-one to {100 * folds:.0f} % of the corners", MODEL, "folds")
    put_back = r["adjustment"] is not None and r["adjustment"]["principal_point_put_back"]
    text = "left the middle by more than 5 % of the width and was put back"
    off = max((100 * principal_point_off(c) for c in lenses), default=0.0)
    yield Measure("sweep-centre", text if put_back else off)


def _unfinished(r: dict[str, Any], side_px: int) -> Iterator[Measure]:
    left_out = max(
        0, r["pairs"]["wanted"] - r["pairs"]["matched"]
    )  # more may be matched than were wanted at first
    late = [a["name"] for a in r["attempts"] if a["out_of_time"]]
    said = [f"{left_out} of {r['pairs']['wanted']} pairs left out"] if left_out else []
    said += [f"mapping stopped: {', '.join(late)}"] if late else []
    said += [f"the worker {r['stopped']}; its best model so far is used"] if r["stopped"] else []
    if said:
        yield Measure("sweep-unfinished", "; ".join(said), why="time")
    if r["adjustment"] is not None and not r["adjustment"]["converged"]:
        text = "the bundle adjustment has not converged: it stopped while the error still fell"
        yield Measure("sweep-unfinished", text, why="loose")
    if side_px != MAX_IMAGE_SIZE:
        text = f"features were looked for in pictures of {side_px} pixels, usual are {MAX_IMAGE_SIZE}"
        yield Measure("sweep-unfinished", text, why="memory")
