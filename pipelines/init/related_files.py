"""Files of a card that are not material of their own: clips of photos, small copies, later chapters, what is unread."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from devrf.capture.ingest.recordings import chapters, is_of_photo, join_command, small_copy_of
from devrf.capture.ingest.survey import PREVIEWS, UNREAD_CLIPS, Material
from devrf.capture.photos.photo_folders import CONVERT, UNREAD_KINDS
from devrf.capture.system.amounts import counted
from devrf.capture.system.doubles import doubles
from devrf.capture.system.errors import DevrfError
from devrf.capture.video.reader import probe_video

LAYOUTS = {  # public ones that no reader is for, by what lies in the folder
    (
        "dataset.json",
        "camera",
    ): "as Nerfies, HyperNeRF and DyCheck have it: one camera that films the scene in motion. "
    "Its poses are not read; a sweep of the scene at rest and clips of fixed cameras are missing",
    (
        "train_meta.json",
        "ims",
    ): "as Dynamic 3D Gaussians has it, which is not read: its cameras are folders of "
    "pictures. Make a clip of each, `ffmpeg -framerate 30 -i ims/0/%06d.jpg -crf 12 0.mp4`, and film a sweep",
}
SMALLER = 0.999  # of the width of the clip of which it is a copy


@dataclass
class Sorted:
    """Clips that are material of their own, and what is said of the others.

    Attributes:
        clips: What is left to be looked at.
        left: File -> why it is not used.
        doubts: What the crew has to do, one sentence each.
    """

    clips: list[Path] = field(default_factory=list)
    left: dict[str, str] = field(default_factory=dict)
    doubts: list[str] = field(default_factory=list)


def sort_clips(folder: Path, material: Material) -> Sorted:
    """Take out what belongs to another file."""
    out = Sorted()
    photos = [photo for listed in (*material.photos.values(), material.unreadable) for photo in listed]
    live: list[Path] = []
    later: dict[Path, str] = {}  # chapter -> name of the first one
    by_length = sorted(material.clips, key=lambda clip: (len(clip.name), clip))  # copies have longer names
    copies = {by_length[n]: by_length[first] for n, first in doubles(by_length).items()}
    for clip in material.clips:
        name, width, duration_s = clip.relative_to(folder).as_posix(), *_size(clip)
        copied = small_copy_of(clip, material.clips)
        if clip in copies:
            out.left[name] = f"a copy of {copies[clip].relative_to(folder).as_posix()}"
        elif is_of_photo(clip, photos, duration_s):
            live.append(clip)
        elif copied is not None and width <= SMALLER * _size(copied)[0]:
            out.left[name] = f"a small copy (proxy) of {copied.relative_to(folder).as_posix()}"
        elif clip in later:
            out.left[name] = f"a later chapter of {later[clip]}"
        else:
            out.clips.append(clip)
            parts = chapters(clip)
            if len(parts) > 1:
                later |= dict.fromkeys(parts, parts[0].name)
                names = ", ".join(part.name for part in parts)
                out.doubts.append(
                    f"{name}: {names} are {len(parts)} chapters of one recording, and only the first is used. "
                    f"Join them in {clip.parent.name}, without coding anew, and name the result instead: "
                    f"{join_command(parts)}"
                )
    out.left |= _by_folder(folder, live, "taken along with photos of the same names (live photos)", "clip")
    return out


def not_read(folder: Path, material: Material) -> dict[str, str]:
    """Files that are not read, by folder and kind, with what to do."""
    left = {
        signs[0]: why for signs, why in LAYOUTS.items() if all((folder / sign).exists() for sign in signs)
    }
    for kind in dict.fromkeys(UNREAD_KINDS.values()):
        files = [f for f in material.unreadable if UNREAD_KINDS.get(f.suffix.lower()) == kind]
        left |= _by_folder(folder, files, f"{kind}, which is not read; {CONVERT}", "photo")
    for suffixes, why in (
        (
            UNREAD_CLIPS,
            "a maker's own RAW or 360° clips, which are not read; export them as H.264, HEVC or ProRes",
        ),
        (PREVIEWS, "the camera's own previews"),
    ):
        left |= _by_folder(folder, [f for f in material.others if f.suffix.lower() in suffixes], why, "file")
    return left


def _by_folder(folder: Path, files: Iterable[Path], why: str, what: str) -> dict[str, str]:
    """One line for the files of a folder that share a reason."""
    groups: dict[Path, list[Path]] = {}
    for file in files:
        groups.setdefault(file.parent, []).append(file)
    lines = {}
    for inside in groups.values():
        more = f" and {len(inside) - 1} more" if len(inside) > 1 else ""
        lines[f"{inside[0].relative_to(folder).as_posix()}{more}"] = f"{counted(len(inside), what)}: {why}"
    return lines


def _size(clip: Path) -> tuple[int, float]:
    """Width and announced length of a clip; 0 and no end where it cannot be read, of which others speak."""
    try:
        info = probe_video(clip)
    except DevrfError:
        return 0, float("inf")
    return info.width, float("inf") if info.duration_s is None else info.duration_s
