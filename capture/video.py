"""Decode video: pictures with their presentation timestamps, upright, one at a time.

File time is the presentation timestamp times the stream's time base, in seconds; it is never index / fps.
Stream formats whose clock starts anywhere (MPEG-TS, MPEG-PS) are counted from the file's first timestamp.
A turn stored in the file (display matrix) is applied here, once. Pictures are RGB uint8 [height, width, 3].
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

import av
import numpy as np
from av.container import InputContainer
from av.error import EOFError as EndOfFile
from av.error import FFmpegError
from av.stream import Disposition
from av.video.reformatter import Colorspace
from av.video.stream import VideoStream
from jaxtyping import UInt8

from devrf.capture.errors import CaptureError, InputError

ARBITRARY_CLOCK_FORMATS = ("mpegts", "mpeg")  # camcorders' .mts starts at 1.4 s or at the time of day
TEXT_FORMATS = ("tty",)  # ffmpeg shows plain text as pictures of letters
UNSPECIFIED_COLORSPACE = 2  # ITU-T H.273, matrix_coefficients
HDR_TRANSFERS = {16: "PQ", 18: "HLG"}  # ITU-T H.273, transfer_characteristics
SNIFF_BYTES = 512
END_TOLERANCE_STEPS = 2  # announced duration minus last timestamp: one step, and rounding
END_TOLERANCE_S = 0.05  # sound may end up to two AAC blocks after the pictures


@dataclass(frozen=True)
class VideoInfo:
    """What a video file says of itself, sizes after its turn is applied.

    Attributes:
        path: The file.
        width, height: Size of the upright pictures, pixels.
        codec: Short name, for example "h264".
        duration_s: Announced duration, or None.
        announced_frames: Number of pictures the container announces, or None.
        fps: Announced mean rate, or None; never used for times.
        has_audio: Whether there is a sound stream.
        rotation_deg: Counter-clockwise turn that makes the stored pictures upright: 0, 90, 180 or 270.
        notes: What is unusual about the file, one sentence each.
    """

    path: Path
    width: int
    height: int
    codec: str
    duration_s: float | None
    announced_frames: int | None
    fps: float | None
    has_audio: bool
    rotation_deg: int
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class VideoFrame:
    """One picture: its index in presentation order, its file time, RGB."""

    index: int
    time_s: float
    rgb: UInt8[np.ndarray, "height width 3"]


def probe_video(path: Path) -> VideoInfo:
    """Look at a video file without reading all of it; its first picture must decode.

    Raises:
        InputError: If the file is missing, empty, not a video, or has no picture that decodes.
    """
    with VideoReader(path) as reader:
        return reader.info


def count_packets(path: Path) -> int:
    """Number of coded pictures that are really in the file (read, not decoded: fast)."""
    with open_media(path) as container:
        stream = _video_stream(container, path)
        count = 0
        try:
            for packet in container.demux(stream):
                if packet.is_corrupt:
                    break
                count += packet.size > 0
        except FFmpegError:
            pass  # what is before the damage counts
        return count


class VideoReader:
    """Streams the pictures of one file: `with VideoReader(path) as reader: for frame in reader: ...`.

    Only one picture is held. `info` is known at once; after the loop `decoded` is the number of pictures and
    `ended_early` says in words where a damaged or truncated file ended (None for a whole one).
    """

    def __init__(self, path: Path) -> None:
        """Open `path` and decode its first picture.

        Raises:
            InputError: If the file is missing, empty, not a video, or has no picture that decodes.
        """
        self.path = Path(path)
        self.decoded = 0
        self.ended_early: str | None = None
        self._failure: str | None = None
        self._container = open_media(self.path)
        try:
            self._stream = _video_stream(self._container, self.path)
            self._stream.thread_type = "AUTO"
            self._origin_s = origin_s(self._container)
            self._pictures = self._decode()
            self._first = next(self._pictures, None)
            if self._first is None:
                raise InputError(
                    f"{self.path}: no picture decodes ({self._failure or 'the video stream is empty'}); "
                    "expected at least one; record the clip again or leave it out"
                )
            self.info = self._describe(self._first)
        except BaseException:
            self._container.close()
            raise

    def __enter__(self) -> "VideoReader":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._container.close()

    def __iter__(self) -> Iterator[VideoFrame]:
        """Yield every picture that decodes, in presentation order. Can be run through once.

        Raises:
            CaptureError: If a picture carries no timestamp.
        """
        picture, self._first = self._first, None
        if picture is None:
            raise ValueError(f"{self.path}: a VideoReader can be read only once")
        turns = self.info.rotation_deg // 90
        while picture is not None:
            if picture.pts is None or self._stream.time_base is None:
                raise CaptureError(
                    f"{self.path}: frame {self.decoded} has no timestamp (a raw stream without container?); "
                    "put it into an mp4 with the true frame rate: `ffmpeg -r 30 -i in.h264 out.mp4`"
                )
            rgb = np.rot90(_rgb(picture), turns) if turns else _rgb(picture)
            time_s = float(picture.pts * self._stream.time_base) - self._origin_s  # flushed ones know no unit
            yield VideoFrame(self.decoded, time_s, np.ascontiguousarray(rgb))
            self.decoded += 1
            picture = next(self._pictures, None)
            if picture is None:
                self.ended_early = self._early_end(time_s)

    def _decode(self) -> Iterator[av.VideoFrame]:
        """Pictures up to the first damage; `_failure` then says what it was."""
        packets = self._container.demux(self._stream)
        while True:
            try:
                packet = next(packets)
                if packet.is_corrupt:
                    self._failure = "the next one is incomplete"
                    packet = None  # flush what the decoder still holds
                yield from self._stream.codec_context.decode(packet)
                if packet is None:
                    return
            except (StopIteration, EndOfFile):
                return
            except FFmpegError as error:
                self._failure = f"damaged after that: {error.strerror}"
                return

    def _early_end(self, last_s: float) -> str | None:
        """Where and why the file ended before its announced end; None where it did not.

        Fewer pictures than announced are no sign alone: clips trimmed in a phone keep the count of the
        whole recording. The announced duration must be missed too.
        """
        announced, duration = self.info.announced_frames, self._container.duration
        of = f" of {announced}" if announced else ""
        if self._failure:
            return f"ends at frame {self.decoded}{of}, {last_s:.2f} s ({self._failure})"
        if not announced or self.decoded >= announced or duration is None:
            return None
        step_s = 1 / self.info.fps if self.info.fps else 0.0
        if last_s + END_TOLERANCE_STEPS * step_s + END_TOLERANCE_S >= duration / av.time_base:
            return None
        return f"ends at frame {self.decoded}{of}, {last_s:.2f} s (the file is cut short)"

    def _describe(self, picture: av.VideoFrame) -> VideoInfo:
        stream, container = self._stream, self._container
        rotation = int(round(picture.rotation / 90.0)) * 90 % 360
        width, height = picture.width, picture.height
        if rotation % 180:
            width, height = height, width
        notes = []
        if rotation:
            notes.append(f"pictures are turned by {rotation} degrees as the file says")
        aspect = stream.sample_aspect_ratio
        if aspect and aspect != 1:
            notes.append(f"pixels are not square ({aspect.numerator}:{aspect.denominator}); left as they are")
        if picture.interlaced_frame:
            notes.append("pictures are interlaced: fast motion shows combs; film in a progressive mode")
        if picture.color_trc in HDR_TRANSFERS:
            notes.append(
                f"HDR video ({HDR_TRANSFERS[picture.color_trc]}): colours are read without tone mapping; "
                "film in a standard profile"
            )
        duration = None
        if stream.duration is not None and stream.time_base is not None:
            duration = float(stream.duration * stream.time_base)
        elif container.duration is not None:
            duration = container.duration / av.time_base
        return VideoInfo(
            path=self.path,
            width=width,
            height=height,
            codec=stream.codec_context.name,
            duration_s=duration,
            announced_frames=stream.frames or None,
            fps=float(stream.average_rate) if stream.average_rate else None,
            has_audio=bool(container.streams.audio),
            rotation_deg=rotation,
            notes=tuple(notes),
        )


def check_file(path: Path) -> None:
    """Raise InputError unless `path` is a file with something in it."""
    if not path.exists():
        raise InputError(f"{path}: no such file; check the path in scene.yaml (relative to scene.yaml)")
    if path.is_dir():
        raise InputError(f"{path}: is a folder, expected a video file")
    if path.stat().st_size == 0:
        raise InputError(f"{path}: the file is empty (0 bytes); copy it from the camera again")


def open_media(path: Path) -> InputContainer:
    """Open a media file for reading.

    Raises:
        InputError: If it is missing, empty, unreadable or not a media file.
    """
    check_file(path)
    try:
        container = av.open(str(path))
    except FFmpegError as error:
        raise InputError(f"{path}: not a video ({_what_is_it(path, error)})") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check its permissions") from None
    if container.format.name in TEXT_FORMATS:
        container.close()
        raise InputError(f"{path}: not a video (it holds text); check the path in scene.yaml")
    return container


def origin_s(container: InputContainer) -> float:
    """What to subtract from this container's timestamps to get file time, seconds."""
    if container.format.name in ARBITRARY_CLOCK_FORMATS and container.start_time is not None:
        return container.start_time / av.time_base
    return 0.0


def _video_stream(container: InputContainer, path: Path) -> VideoStream:
    streams = [s for s in container.streams.video if not s.disposition & Disposition.attached_pic]
    if not streams:
        kinds = ", ".join(sorted({s.type for s in container.streams})) or "nothing"
        raise InputError(f"{path}: has no video stream (it holds: {kinds}); check the path in scene.yaml")
    return streams[0]


def _rgb(picture: av.VideoFrame) -> UInt8[np.ndarray, "height width 3"]:
    """RGB of a decoded picture; unlabelled HD is BT.709 and smaller is BT.601, as players do it."""
    space: int | Colorspace = picture.colorspace
    if space == UNSPECIFIED_COLORSPACE:
        hd = picture.width >= 1280 or picture.height > 576
        space = Colorspace.ITU709 if hd else Colorspace.ITU601
    return picture.to_ndarray(format="rgb24", src_colorspace=space)


def _what_is_it(path: Path, error: Exception) -> str:
    """What an unreadable file seems to be, and what to do."""
    with path.open("rb") as file:
        head = file.read(SNIFF_BYTES)
    if b"ftyp" in head[:16]:
        return "an mp4 or mov whose index is missing: the recording or the copy was cut short; copy it again"
    try:
        head.decode("utf-8")
        return "it holds text; check the path in scene.yaml"
    except UnicodeDecodeError:
        reason = getattr(error, "strerror", None) or str(error)
        return f"{reason}; expected mp4, mov, mkv, avi or another format ffmpeg reads"
