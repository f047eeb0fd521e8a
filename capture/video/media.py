"""Open a media file, and say in words what is wrong with one that cannot be."""

from pathlib import Path

import av
from av.container import InputContainer
from av.error import FFmpegError
from av.stream import Disposition
from av.video.stream import VideoStream

from devrf.capture.system.cores import usable_cores
from devrf.capture.system.errors import InputError
from devrf.capture.system.limits import CLIP_PX, check_pixels

ARBITRARY_CLOCK_FORMATS = ("mpegts", "mpeg")  # camcorders' .mts starts at 1.4 s or at the time of day
CONTAINERS = "mov,matroska,avi,mpegts,mpeg,mxf,asf,flv,ogg,dv,yuv4mpegpipe,wav,mp3,aac,flac"
"""FFmpeg's names of what cameras and recorders write, and what programs hand on.

None of them opens other files, as lists, playlists and patterns of FFmpeg's four hundred formats do.
"""
SNIFF_BYTES = 512
START_CODE = b"\0\0\0\1"  # of H.264 and H.265 without a container (Annex B)
MOST_THREADS = 16  # ffmpeg itself takes no more unless asked, and advises against it


def check_file(path: Path) -> None:
    """Raise InputError unless `path` is a file with something in it."""
    if not path.exists():
        text = f"{path}: no such file; check the path in scene.yaml (relative to scene.yaml)"
        raise InputError("file-missing", text)
    if path.is_dir():
        raise InputError("file-is-folder", f"{path}: is a folder, expected a video file")
    if path.stat().st_size == 0:
        raise InputError("file-empty", f"{path}: the file is empty (0 bytes); copy it from the camera again")


def open_media(path: Path) -> InputContainer:
    """Open a media file for reading.

    Raises:
        InputError: If it is missing, empty, unreadable or not a media file.
    """
    check_file(path)
    try:
        return av.open(
            f"file:{path}",  # whatever else a name may mean to FFmpeg
            options={"format_whitelist": CONTAINERS, "protocol_whitelist": "file"},
            metadata_errors="replace",  # of cameras in other alphabets, and damaged
        )
    except FFmpegError as error:
        raise _what_is_it(path, error) from None
    except OSError as error:
        text = f"{path}: cannot be read ({error.strerror}); check its permissions"
        raise InputError("file-unreadable", text) from None


def origin_s(container: InputContainer) -> float:
    """What to subtract from this container's timestamps to get file time, seconds."""
    if container.format.name in ARBITRARY_CLOCK_FORMATS and container.start_time is not None:
        return container.start_time / av.time_base
    return 0.0


def tag(container: InputContainer, name: str) -> str | None:
    """A tag of the file, or of the first of its streams that has it; None without."""
    holders = (container.metadata, *(stream.metadata for stream in container.streams))
    return next((tags[name] for tags in holders if name in tags), None)


def mean_fps(container: InputContainer, path: Path) -> float | None:
    """Announced mean rate of the pictures of `video_stream`, or None; errors as of it."""
    rate = video_stream(container, path).average_rate
    return float(rate) if rate else None


def video_stream(container: InputContainer, path: Path, threads: int | None = None) -> VideoStream:
    """The stream of the largest pictures, the first of several; its decoder refuses pictures that are too large.

    Args:
        container: The open file.
        path: Its name, for messages.
        threads: Of the decoder, each of which holds a picture; None: one per core. They change no picture.
    Raises:
        InputError: If there is none.
        CaptureError: If its pictures are larger than any camera's.
    """
    streams = video_streams(container)
    if not streams:
        kinds = ", ".join(sorted({s.type for s in container.streams})) or "nothing"
        text = f"{path}: has no video stream (it holds: {kinds}); check the path in scene.yaml"
        raise InputError("video-missing", text)
    known = [s for s in streams if s.codec_context is not None]
    stream = max(known, key=lambda s: s.codec_context.width * s.codec_context.height, default=None)
    if stream is None:
        text = f"{path}: its pictures are coded in a way that is not known; convert it to H.264"
        raise InputError("video-unknown", text)
    if stream.codec_context.width * stream.codec_context.height:  # else the first picture tells
        check_pixels(path, stream.codec_context.width, stream.codec_context.height, CLIP_PX)
    stream.thread_type = "AUTO"
    stream.codec_context.thread_count = min(threads or usable_cores(), MOST_THREADS)
    stream.codec_context.options = {**stream.codec_context.options, "max_pixels": str(CLIP_PX)}
    return stream


def video_streams(container: InputContainer) -> list[VideoStream]:
    """Streams of pictures that are no covers; cameras write small copies and a second lens beside the main one."""
    return [s for s in container.streams.video if not s.disposition & Disposition.attached_pic]


def _what_is_it(path: Path, error: Exception) -> InputError:
    """What an unreadable file seems to be, and what to do."""
    with path.open("rb") as file:
        head = file.read(SNIFF_BYTES)
    if b"ftyp" in head[:16]:
        why = "an mp4 or mov whose index is missing: the recording or the copy was cut short"
        return InputError("file-cut-short", f"{path}: not a video ({why}); copy it again")
    if head.startswith(START_CODE):
        remedy = f"put it into an mp4 with the true frame rate: `ffmpeg -r 30 -i {path.name} {path.stem}.mp4`"
        return InputError(
            "stream-without-times", f"{path}: a raw stream, whose pictures have no times; {remedy}"
        )
    try:
        head.decode("utf-8")
        return _is_text(path)
    except UnicodeDecodeError:
        reason = getattr(error, "strerror", None) or str(error)
        expected = "expected mp4, mov, mkv, avi, ts, mxf or another container of clips"
        return InputError("file-not-video", f"{path}: not a video ({reason}); {expected}")


def _is_text(path: Path) -> InputError:
    text = f"{path}: not a video (it holds text); check the path in scene.yaml"
    return InputError("file-is-text", text)
