"""How many pictures of raw files are decoded, developed and written at once, by what their headers say."""

from typing import TYPE_CHECKING

from devrf.capture.amounts import size_text
from devrf.capture.photo_folders import list_pictures
from devrf.capture.pictures import probe_picture
from devrf.capture.raw import is_raw
from devrf.capture.session import CaptureSession
from devrf.capture.video import probe_video
from devrf.pipelines.budget.at_once import BASE, fitting
from devrf.pipelines.budget.memory import allowed_bytes, memory_bound
from devrf.pipelines.stage import StageContext

if TYPE_CHECKING:
    from devrf.pipelines.config.scene import SceneConfig

# Bytes for each pixel of a picture
REFERENCES = 12  # that the decoder of a clip keeps to predict others from; twice with more than 8 bits
DECODED, DECODED_DEEP = 7, 30  # for each one decoded or written; with more than 8 bits, on its way to 8
PHOTO, RAW = 10, 30  # a photo read and measured; a RAW photo developed (12 to 24 megapixels: 23 to 29)

SOUND_READ = 48_000 * 16  # bytes a second of decoded sound


def photos_too_large(config: "SceneConfig", session: CaptureSession) -> list[str]:
    """What is wrong with photos of which not even one fits into the memory that is allowed, one text per folder."""
    allowed, problems = allowed_bytes(config), []
    for folder in (session.static, *session.board_clips.values()):
        if folder is None or not folder.is_dir():
            continue
        photos = [(probe_picture(path), RAW if is_raw(path) else PHOTO) for path in list_pictures(folder)]
        photo, rate = max(photos, key=lambda each: each[1] * each[0].width * each[0].height)
        needed = BASE + rate * photo.width * photo.height
        if needed > allowed:
            size = f"{photo.width}x{photo.height}"
            problems.append(
                f"{photo.path}: a photo of {size} needs about {size_text(needed)} of memory, and {size_text(allowed)} "
                f"are allowed ({memory_bound(config, allowed)}), or make the photos smaller"
            )
    return problems


def ingested_at_once(context: StageContext, session: CaptureSession) -> int:
    """Pictures in memory at once, of whatever file they are."""
    held, each, sound_s = [0], [0], 0.0
    heard = {*session.cameras.values(), *session.joint_clips.values()}
    for path in {session.static, *session.board_clips.values(), *heard} - {None}:
        if path.is_dir():
            first = list_pictures(path)[0]
            photo = probe_picture(first)
            (each if is_raw(first) else held).append(
                (RAW if is_raw(first) else PHOTO) * photo.width * photo.height
            )
            continue
        clip = probe_video(path)
        deep, pixels = clip.bits > 8, clip.width * clip.height
        held.append((REFERENCES + REFERENCES * deep) * pixels)
        each.append((DECODED_DEEP if deep else DECODED) * pixels)
        sound_s += clip.duration_s or 0.0 if clip.has_audio and path in heard else 0.0
    base = BASE + max(held) + int(SOUND_READ * sound_s)
    return fitting(context, base + max(each), max(each))  # the writer has one more in its hands
