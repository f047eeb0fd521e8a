"""The report's capture section: what each camera recorded, and a few of its pictures."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from devrf.capture.scene import PosedFrame, Scene
from devrf.pipelines.report.html import absent, figure, number, section, table, text
from devrf.pipelines.report.mattes import mattes
from devrf.pipelines.report.pictures import picture_uri, read_picture
from devrf.pipelines.report.run import RunFolder, evenly

THUMBNAIL_WIDTH = 200
SWEEP_THUMBNAILS, CAMERA_THUMBNAILS = 8, 3
MAX_THUMBNAIL_CAMERAS = 12  # keeps the page small for a capture of forty cameras
INGEST = "ingest/ingest.json"
ROLES = {
    "sweep": "sweep",
    "camera": "moving",
    "test": "test, never trained on",
    "board": "board",
    "joint": "board, several cameras",
}


def capture_section(run: RunFolder) -> str:
    """Cameras table and contact strip."""
    lead = "What was filmed, as the decoder found it."
    cameras = run.cameras(INGEST)
    if cameras:
        boards = {n: c for n, c in cameras.items() if c.get("role") in ("board", "joint")}
        filmed = {n: c for n, c in cameras.items() if n not in boards}
        body = _cameras_table(cameras) + _strip(_ingest_pictures(run.folder("ingest"), filmed))
        strip = _strip(_ingest_pictures(run.folder("ingest"), boards))
        body += f"<details><summary>Board clips</summary>{strip}</details>" if strip else ""
        return section("capture", "Capture", lead, body + mattes(run.scene))
    pictures = _dataset_pictures(run.scene)
    if not pictures:
        return section("capture", "Capture", lead, absent(run.why_absent("ingest")))
    lead = "A finished data set: its pictures came with cameras and times, so nothing was ingested."
    return section("capture", "Capture", lead, _strip(pictures) + mattes(run.scene))


def _cameras_table(cameras: dict[str, Any]) -> str:
    rows = []
    for name, camera in cameras.items():
        key = f"cameras.{name}"
        frames = camera.get("frames") or []
        used = sum(bool(f.get("used")) for f in frames)
        rate = number(camera.get("fps_mean"), "", 2, file=INGEST, key=f"{key}.fps_mean", why="pictures")
        rows.append(
            [
                f"<strong>{text(name)}</strong><br><code>{text(camera.get('source', ''))}</code>",
                text(ROLES.get(str(camera.get("role")), camera.get("role", ""))),
                f"{text(camera.get('width', '?'))} × {text(camera.get('height', '?'))}",
                rate if camera.get("fps_mean") else '<span class="none">pictures</span>',
                f"{used} of {len(frames)}",
                "yes" if camera.get("has_audio") else "no",
                text("; ".join(_notes(camera))),
            ]
        )
    head = ("camera", "role", "size, px", "frames/s", "frames used", "sound", "notes")
    return table(head, rows, source=INGEST, numeric=(2, 3, 4))


def _notes(camera: dict[str, Any]) -> list[str]:
    notes = [str(note) for note in camera.get("notes") or []]
    notes += [str(fault["found"]) for fault in camera.get("faults") or []]
    if camera.get("ended_early"):
        notes.insert(0, str(camera["ended_early"]))
    if camera.get("missing_frames"):
        notes.insert(0, f"{camera['missing_frames']} frames missing")
    if camera.get("variable_rate") and not any("variable" in note for note in notes):
        notes.insert(0, "variable frame rate")
    return notes


def _ingest_pictures(folder: Path, cameras: dict[str, Any]) -> list[tuple[str, list[tuple[Path, str]]]]:
    """Per camera its name and (file, caption) of a few frames."""
    rows = []
    for name, camera in list(cameras.items())[:MAX_THUMBNAIL_CAMERAS]:
        frames = [f for f in camera.get("frames") or [] if f.get("file")]
        count = SWEEP_THUMBNAILS if camera.get("role") == "sweep" else CAMERA_THUMBNAILS
        rows.append(
            (
                name,
                [
                    (folder / _below_ingest(f["file"]), _caption(f.get("index"), f.get("time_s")))
                    for f in evenly(frames, count)
                ],
            )
        )
    return rows


def _below_ingest(file: str) -> str:
    return file.removeprefix("ingest/")


def _dataset_pictures(scene: Scene | None) -> list[tuple[str, list[tuple[Path, str]]]]:
    rows = []
    parts = ((scene.static, SWEEP_THUMBNAILS), (scene.dynamic, CAMERA_THUMBNAILS)) if scene else ()
    for frames, count in parts:
        by_camera: dict[str, list[PosedFrame]] = {}
        for frame in frames:
            by_camera.setdefault(frame.camera_name, []).append(frame)
        for name, of_camera in list(by_camera.items())[:MAX_THUMBNAIL_CAMERAS]:
            rows.append((name, [(f.path, _caption(f.index, f.time_s)) for f in evenly(of_camera, count)]))
    return rows


def _caption(index: object, time_s: object) -> str:
    time = f", {time_s:.3f} s" if isinstance(time_s, (int, float)) else ""
    return f"frame {index}{time}"


def _strip(rows: Sequence[tuple[str, list[tuple[Path, str]]]]) -> str:
    out = []
    for name, pictures in rows:
        figures = []
        for path, caption in pictures:
            image = read_picture(path)
            if image is not None:
                uri = picture_uri(image, THUMBNAIL_WIDTH)
                figures.append(figure(uri, text(caption), f"{name}, {caption}"))
        if figures:
            wide = " wide" if len(figures) > CAMERA_THUMBNAILS else ""
            strip = f'<div class="strip">{"".join(figures)}</div>'
            out.append(f'<div class="reel{wide}"><h3>{text(name)}</h3>{strip}</div>')
    return f'<div class="reels">{"".join(out)}</div>' if out else ""
