"""Stage `static_poses`: where the sweep's pictures were taken, and whether that can be trusted."""

import json
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from devrf.calibration.boards.calibrate import BoardCalibration, calibrate_intrinsics
from devrf.calibration.boards.find import find_board
from devrf.calibration.intrinsics import Intrinsics
from devrf.calibration.sweep.devices import device_groups
from devrf.calibration.sweep.masks import prepare_masks
from devrf.calibration.sweep.static_poses import (
    SweepModel,
    SweepOptions,
    SweepPictures,
    recover_static_poses,
)
from devrf.capture.bursts import bursts
from devrf.capture.exif import Exif
from devrf.capture.frames import SWEEP, CameraFrames, FrameSet, some
from devrf.capture.measure import noted
from devrf.capture.orientation import by_exif
from devrf.capture.photos.photo_folders import list_pictures
from devrf.capture.photos.picture_files import open_picture
from devrf.capture.system.progress import Progress, no_progress
from devrf.pipelines.budget.at_once import swept_at_once
from devrf.pipelines.health.board_rows import board_measures, fits
from devrf.pipelines.health.sweep_rows import sweep_measures
from devrf.pipelines.inputs.board_clips import files_of
from devrf.pipelines.inputs.board_spec import board_spec, lens_choice
from devrf.pipelines.stage import StageContext

BOARD = f"board_{SWEEP}"


def run(context: StageContext) -> None:
    """Write `static_poses.json`, `colmap/`, `points.npz` and `colmap.log`."""
    ingest = context.run_dir / "ingest"
    frames = FrameSet.read(ingest)
    capture = context.config.capture
    assert capture is not None and capture.static is not None  # else the stage does not apply
    board = _board(context, frames)
    sfm = context.config.calibration.static_poses
    stored = None
    if board is not None and fits(board):
        stored = board.intrinsics.turned(frames.cameras[BOARD].upright.inverse)
    threads, side_px = swept_at_once(context, frames.cameras[SWEEP])
    masks = None
    if sfm.masks is not None:
        folder, source = (context.config.path(context.scene_dir, p) for p in (sfm.masks, capture.static))
        masks = folder, source
    options = SweepOptions(sfm.mapper, context.allowance.left_s, threads, side_px)
    swept = Swept(ingest, frames.cameras[SWEEP], stored, masks)
    model, notes = recover_sweep(swept, context.out, options, context.progress)
    lens = None if stored is None else stored.turned(frames.cameras[SWEEP].upright)
    context.measures += sweep_measures(model, lens, side_px, frames.cameras[SWEEP].pixel_aspect)
    for about, texts in notes.items():
        context.measures += noted(texts, about)
    if board is not None:
        _add_board(context.out / "static_poses.json", board)
        context.measures += board_measures(SWEEP, board)


@dataclass(frozen=True)
class Swept:
    """What is known of the sweep's pictures.

    Attributes:
        ingest: The ingest folder.
        frames: Its entry of the sweep.
        known: Intrinsics by a board, of pictures as they are stored.
        masks: Folder of masks, and the sweep itself (a film or a folder of photos), whose files they are called by.
    """

    ingest: Path
    frames: CameraFrames
    known: Intrinsics | None = None
    masks: tuple[Path, Path] | None = None


def recover_sweep(
    swept: Swept, out: Path, options: SweepOptions, progress: Progress = no_progress
) -> tuple[SweepModel, dict[str, list[str]]]:
    """Structure from motion of the pictures that ingest left, with all that their tags say.

    Args:
        swept: The pictures.
        out: Where `recover_static_poses` writes.
        options: Threads, size of pictures and time that it may use.
        progress: Told how far it is.
    Returns:
        The model, and what is to be known of masks and bursts, by what it is about.
    """
    ingest, sweep = swept.ingest, swept.frames
    used = {f.file.removeprefix("frames/"): f for f in sweep.used if f.file is not None}
    sizes = {name: _size(ingest / "frames" / name) for name in used}
    exif = {name: frame.exif for name, frame in used.items() if frame.exif is not None}
    film = sweep.fps_mean is not None
    turns = {n: sweep.upright if film else by_exif(f.orientation or 1) for n, f in used.items()}
    with tempfile.TemporaryDirectory(dir=out, prefix="masks-") as masks:
        notes: dict[str, list[str]] = {"masks": [], "held-out pictures": []}
        if swept.masks is not None:
            folder, source = swept.masks
            photos = [] if film else [photo.name for photo in list_pictures(source)]
            called = {n: Path(n).name if film else photos[frame.index] for n, frame in used.items()}
            re_turned = {n: frame.re_turned for n, frame in used.items()}
            count = len(sweep.frames) if film else len(photos)
            without, from_1 = prepare_masks(folder, called, sizes, Path(masks), re_turned, count)
            notes["masks"] += [f"no mask: {some(without)}"] if without else []
            if from_1:
                notes["masks"].append(f"numbered from 1 to {count}, so that 1 is that of the first picture")
        pictures = SweepPictures(
            ingest / "frames",
            device_groups(sizes, exif, swept.known, sweep.pixel_aspect, turns),
            ordered=film,
            masks=None if swept.masks is None else Path(masks),
            places={name: tags.place for name, tags in exif.items()},
        )
        model = recover_static_poses(pictures, out, options, progress)
    if not film:  # frames of a film are all near one another
        model = _with_bursts(model, exif, out / "static_poses.json")
        doubles = model.report["bursts"]
        text = f"{len(doubles)} bursts, of {some([f'{b[0]} and {len(b) - 1} more' for b in doubles])}"
        notes["held-out pictures"] += [f"{text}: each is held out whole or not at all"] if doubles else []
    return model, notes


def _with_bursts(model: SweepModel, exif: Mapping[str, Exif], file: Path) -> SweepModel:
    """The model that knows which photos are near-doubles, in its file too."""
    found = bursts(model.cameras, [exif[n].taken_s if n in exif else None for n in model.names])
    report = model.report | {"bursts": [[model.names[k] for k in members] for members in found]}
    file.write_text(json.dumps(report, indent=1))
    return replace(model, report=report)


def _size(file: Path) -> tuple[int, int]:
    with open_picture(file) as picture:
        return picture.size


def _board(context: StageContext, frames: FrameSet) -> BoardCalibration | None:
    """Intrinsics of the sweep's device from its board clip, where there is one."""
    clip = frames.cameras.get(BOARD)
    spec = board_spec(context.config)
    if clip is None or spec is None:
        return None
    files, size = files_of(context.run_dir, clip), (clip.width, clip.height)
    views, settled = find_board(f"{BOARD} ({clip.source})", files, spec, context.progress)
    return calibrate_intrinsics(
        SWEEP, views, settled, size, lens_choice(context.config), pixel_aspect=clip.pixel_aspect
    )


def _add_board(file: Path, board: BoardCalibration) -> None:
    report = json.loads(file.read_text())
    file.write_text(json.dumps(report | {"board": board.as_dict()}, indent=1))
