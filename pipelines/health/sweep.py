"""Health rows of a sweep: how much was registered, how well it is fixed, and which fault it shows.

The measures come from `calibration`; here is how much is too much, and what a crew can do about it.
"""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from devrf.calibration.intrinsics import Intrinsics
from devrf.calibration.sweep.checks import (
    bend,
    field_of_view_deg,
    fold,
    open_loop,
    picture_fits,
    plane_share,
    principal_point_off,
    two_zooms,
)
from devrf.calibration.sweep.static_poses import SweepModel
from devrf.pipelines.health.rows import HealthRow, note, row

LISTED = 6  # names in a message
STARVED = 500  # features of a picture; below it matching is a matter of luck ...
STARVED_PER_PIXEL = 1 / 250  # ... of small pictures: this many per pixel
MOVING_SHARE = 0.1  # of a picture's textured tiles
ZOOMS_APART = 0.05  # relative; a lens breathes by 1 to 3 % when it focuses
EXIF_WARN, EXIF_BAD = 5.0, 15.0  # percent
# percent of distortion, half-way to the corners: of a corrected lens, of one that is not
STRAIGHT, BENT = 0.3, 1.5
CROP = "; is it the 35 mm equivalent of another crop?"
FOCAL_REMEDY = (
    "Zoom, stabilisation or a wrong EXIF focal length: film the sweep at one fixed zoom without "
    "stabilisation, or film a board with the same settings (capture.board.clips.static)."
)


def sweep_rows(model: SweepModel) -> list[HealthRow]:
    """All rows about a recovered sweep."""
    return [
        *_registered(model.report),
        *_pairs(model.report),
        *_lenses(model),
        *_residuals(model),
        *loop_rows(model),
        *_time(model.report),
        note("mapper", str(model.report["mapper"])),
    ]


def mask_rows(without: Sequence[str]) -> list[HealthRow]:
    """A row about pictures without a mask, where masks are given."""
    if not without:
        return []
    text = f"{len(without)} pictures have none: {_some(without)}"
    return [note("masks", text, remedy="What moves in them is matched: add their masks.")]


def board_bend_rows(model: SweepModel, board: Intrinsics) -> list[HealthRow]:
    """A row where only one of sweep and board was filmed with the camera's own lens correction; else none."""
    ids, frames = _board_lenses(model), model.report["frames"]
    seen = [c for name, c in zip(model.names, model.cameras, strict=True) if frames[name]["camera_id"] in ids]
    if not seen:
        return []
    of_sweep, of_board = 100 * bend(seen[0]), 100 * bend(board.at(np.eye(3, 4)))
    straight, bent = sorted((abs(of_sweep), abs(of_board)))
    if straight > STRAIGHT or bent < BENT:
        return []
    return [
        note(
            "lens correction in the camera",
            f"the sweep's pictures bend by {of_sweep:+.1f} %, the board's by {of_board:+.1f} %",
            remedy="The camera corrects its lens in one mode only: switch the correction off, or film the board in the "
            "mode of the sweep (capture.board.clips.static).",
        )
    ]


def _board_lenses(model: SweepModel) -> list[int]:
    """Cameras of the model that started from a board."""
    starts = [s for s in model.report["start"] if s["source"] == "board"]
    return [s["camera_id"] for s in starts if s["camera_id"] is not None]


def board_focal_row(model: SweepModel, board: Intrinsics) -> HealthRow:
    """Whether the sweep and the board agree on the lens; not measured where no picture of that lens is in the model."""
    focals = [model.report["cameras"][str(n)]["K"][0][0] for n in _board_lenses(model)]
    return row(
        "focal length against the board",
        100 * abs(focals[0] / board.K[0, 0] - 1) if focals else None,
        "%",
        warn_above=EXIF_WARN,
        fail_above=EXIF_BAD,
        remedy=FOCAL_REMEDY,
    )


def _registered(r: dict[str, Any]) -> Iterator[HealthRow]:
    counts: dict[str, int] = r["points_per_image"]
    yield row(
        "registered share of the sweep",
        r["registered"] / r["given"],
        warn=0.8,
        fail=0.4,
        remedy=f"{r['registered']} of {r['given']} pictures; missing: {_some(r['unregistered'])}. A small "
        "model can look perfect: film with 70 % overlap between pictures, walk sideways, and show texture.",
    )
    yield row(
        "mean reprojection error",
        r["mean_reprojection_px"],
        "px",
        warn_above=1.0,
        fail_above=2.0,
        remedy="Something moved during the sweep, or the lens changed: keep the scene at "
        "rest, lock focus and zoom.",
    )
    yield row(
        "mean track length",
        r["mean_track_length"],
        "pictures",
        warn=3.0,
        remedy="Points are seen in too few pictures: more overlap between neighbouring pictures.",
    )
    yield row(
        "points of the poorest picture",
        float(min(counts.values(), default=0)),
        warn=100.0,
        fail=30.0,
        remedy=f"Weak texture in {_some([n for n, p in counts.items() if p < 100])}: "
        "keep textured things in view, or add some for the sweep.",
    )
    yield row(
        "median triangulation angle",
        r["median_triangulation_angle_deg"],
        "deg",
        warn=3.0,
        fail=1.5,
        remedy="The camera turned more than it moved (one homography explains "
        f"{100 * r['verified_pairs']['homography_share']:.0f} % of the pairs): walk sideways around the scene.",
    )
    yield _texture(r)
    lost = set(r["unregistered"])  # pictures that the largest model has too are missed by nobody
    apart = [m for m in r["other_models"] if lost.intersection(m)]
    if apart:
        joined = "; ".join(f"{len(m)}: {_some(m)}" for m in apart)
        yield note(
            "one model",
            f"{len(r['models'])} models: {', '.join(map(str, r['models']))} pictures",
            remedy=f"The largest is used; apart from it stand {joined}. Film pictures that join them.",
        )
    adjustment = r["adjustment"]
    if adjustment is not None and not adjustment["converged"]:
        yield note(
            "bundle adjustment",
            "not converged: it stopped while the error still fell",
            remedy="Something leaves the model loose (focal and distance, a flat scene): film a board "
            "(capture.board.clips.static), or from more sides.",
        )


def _texture(r: dict[str, Any]) -> HealthRow:
    pixels = max((c["width"] * c["height"] for c in r["cameras"].values()), default=0)
    enough = min(STARVED, STARVED_PER_PIXEL * pixels)
    starved = [n for n, count in r["features_per_image"].items() if count < enough]
    return row(
        "pictures with enough features",
        1 - len(starved) / max(1, r["given"]),
        warn=0.9,
        remedy=f"Fewer than {enough:.0f} features in {_some(starved)}: blank walls, dark or blurred pictures. Put "
        "textured things (posters, newspapers, rugs) there for the sweep, give light, walk slowly.",
    )


def _pairs(r: dict[str, Any]) -> Iterator[HealthRow]:
    pairs = r["verified_pairs"]
    moving = sorted(n for n, share in pairs["moving"].items() if share > MOVING_SHARE)
    wrong = pairs["contradicting"]
    listed = _some([" - ".join(pair["names"]) for pair in wrong])
    yield row(
        "strong pairs that contradict the model",
        100 * len(wrong) / max(1, pairs["strong_pairs"]),
        "%",
        warn_above=5.0,
        remedy=f"Views of different sides are matched as one: {listed}. Repeated things (tiles, equal "
        "chairs, both sides of a sign) do that: add things that are unique (posters, coded targets).",
    )
    yield row(
        "neighbouring pictures that contradict the model",
        float(len(r["torn"])),
        warn_above=0.0,
        remedy=f"The sweep's path is torn: {_some([' - '.join(names) for names in r['torn']])} show the same place, "
        "but lie apart in the model. Repeated things (tiles, equal chairs) or things that moved during the sweep do "
        "that: add things that are unique (posters, coded targets), keep still what can move, and film more slowly.",
    )
    yield row(
        "pictures in which something moves",
        len(moving) / max(1, r["registered"]),
        warn_above=0.1,
        remedy=f"Matches that stay together do not fit the camera's motion in {_some(moving)}: empty the scene "
        "for the sweep, or mask what moves (calibration.static_poses.masks).",
    )
    yield row(
        "pairs matched on a static overlay",
        100 * pairs["watermark_share"],
        "%",
        warn_above=5.0,
        remedy="A logo, a time stamp or dirt on the lens is the same in every picture: switch it off, crop it, or "
        "mask it (calibration.static_poses.masks).",
    )


def _lenses(model: SweepModel) -> Iterator[HealthRow]:
    r = model.report
    cameras = list({camera.lens: camera for camera in model.cameras}.values())
    found = {k: c["K"][0][0] for k, c in r["cameras"].items()}
    priors = [s for s in r["start"] if s["source"] == "EXIF" and s["camera_id"] is not None]
    for start in priors:
        focal = found[str(start["camera_id"])]
        percent = 100 * abs(focal / start["focal_px"] - 1)
        which = "" if len(priors) == 1 else f" of {start['label']}"
        yield row(
            f"focal length against EXIF{which}",
            percent,
            "%",
            warn_above=EXIF_WARN,
            remedy=f"EXIF says {start['focal_px']:.0f} px, the pictures say {focal:.0f} px"
            f"{CROP if percent > EXIF_BAD else '. '}{FOCAL_REMEDY}",
        )
    many = [found[str(s["camera_id"])] / s["focal_px"] for s in priors if s["registered"] >= 2]
    if len(many) > 1:
        middle = sorted(many)[len(many) // 2]
        yield row(
            "scatter of focal lengths between cameras",
            100 * max(abs(ratio / middle - 1) for ratio in many),
            "%",
            warn_above=5.0,
            remedy="Intrinsics of several cameras or zooms are unstable, too few pictures fix each: keep one "
            "camera at one zoom for the sweep.",
        )
    middle = "the principal point, which can be put anywhere then: use whole pictures, or film a board "
    middle += "(capture.board.clips.static)."
    if r["adjustment"] is not None and r["adjustment"]["principal_point_put_back"]:
        text = "left the middle by more than 5 % of the width and was put back"
        yield note("principal point", text, remedy=f"The sweep does not fix {middle}")
    yield row(
        "principal point off the middle",
        max((100 * principal_point_off(c) for c in cameras), default=0.0),
        "% of the width",
        warn_above=5.0,
        remedy=f"The pictures were cropped, or the sweep does not fix {middle}",
    )
    yield row(
        "field of view",
        max((field_of_view_deg(c) for c in cameras if c.model == "OPENCV"), default=0.0),
        "deg",
        warn_above=110.0,
        remedy="So wide a lens needs a fisheye model: film a board with it (capture.board.clips.static), or use "
        "the camera's linear mode.",
    )
    folds = [fold(c) for c in cameras]
    if min(folds) < float("inf"):
        yield row(
            "picture radius within which the lens model is one-to-one",
            min(folds),
            "of the corner's",
            warn=1.0,
            remedy="The distortion folds inside the picture, so its corners are wrong: film things near the "
            "corners, or a board (capture.board.clips.static).",
        )


def _residuals(model: SweepModel) -> Iterator[HealthRow]:
    fits = picture_fits(model)
    zooms = two_zooms(model, fits, ZOOMS_APART)
    yield row(
        "share of points on one plane",
        plane_share(model),
        warn_above=0.9,
        remedy="The scene is flat, which leaves the focal length poorly fixed: film a board with the same "
        "settings (capture.board.clips.static), or bring depth into view.",
    )
    yield row(
        "residuals by row of the picture",
        fits.rows_px,
        "px",
        warn_above=0.3,
        remedy="Errors depend on the row: a rolling shutter in motion. Move slowly, use a short shutter and a mode "
        "with fast readout, or take still photos.",
    )
    if zooms is not None:
        yield note(
            "one focal length for all pictures",
            f"two groups, {100 * (zooms.ratio - 1):.0f} % apart",
            remedy=f"{_some(zooms.short)} want a shorter focal length than {_some(zooms.long)}: two zooms or two "
            "devices. Keep one zoom, or save photos with their EXIF data, which tell them apart.",
        )


def loop_rows(model: SweepModel) -> list[HealthRow]:
    """Whether pictures of the same place, taken far apart in time, share points."""
    loop = open_loop(model)
    if loop is None:
        return []
    share, (a, b) = loop
    return [
        row(
            "pictures of the same place that share points",
            share,
            warn=0.2,
            remedy=f"The path comes back, but {a} and {b} share no point: the loop is not closed and the model may "
            "have drifted. Film the overlap again slowly.",
        )
    ]


def _time(r: dict[str, Any]) -> list[HealthRow]:
    pairs = r["pairs"]
    left_out = pairs["wanted"] - pairs["matched"]
    late = [a["name"] for a in r["attempts"] if a["out_of_time"]]
    said = []
    if left_out:
        said.append(f"{left_out} of {pairs['wanted']} pairs left out")
    if late:
        said.append(f"mapping stopped: {', '.join(late)}")
    if r["stopped"]:
        said.append(f"the worker {r['stopped']}; its best model so far is used")
    if not said:
        return []
    remedy = "Give more time (budget.time_minutes), or use fewer or smaller pictures."
    return [note("time for the sweep", "; ".join(said), remedy=remedy)]


def _some(names: Sequence[Any]) -> str:
    more = f" and {len(names) - LISTED} more" if len(names) > LISTED else ""
    return (", ".join(str(n) for n in names[:LISTED]) + more) or "none"
