"""Decode video: pictures with their presentation timestamps, upright, one at a time.

File time is the presentation timestamp times the stream's time base, in seconds; it is never index / fps.
Stream formats whose clock starts anywhere (MPEG-TS, MPEG-PS) are counted from the file's first timestamp.
What the file asks for (display matrix: a turn, a mirror) is applied here, once. Pictures are 8-bit sRGB
[height, width, 3].
"""

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from types import TracebackType

import av
import cv2
import numpy as np
from av.error import EOFError as EndOfFile
from av.error import FFmpegError
from jaxtyping import Int, UInt8

from devrf.capture.colour.primaries import NAMES
from devrf.capture.orientation import Upright, by_display_matrix
from devrf.capture.projection import Projection, of_sphere
from devrf.capture.system.errors import CaptureError, InputError
from devrf.capture.system.limits import check_span
from devrf.capture.video.media import open_media, origin_s, video_stream, video_streams
from devrf.capture.video.packets import Packets, scan_packets
from devrf.capture.video.video_colour import (
    bgr_of,
    bits_of,
    hdr_transfer,
    small_luma,
    small_rgb,
    wide_primaries,
)

END_TOLERANCE_STEPS = 2  # announced duration minus last timestamp: one step, and rounding
END_TOLERANCE_S = 0.05  # sound may end up to two AAC blocks after the pictures
CODING_ORDER_FORMATS = ("avi",)  # their times tell where a picture is in the file, not when it is shown
SEEK_TRIES = 3  # key pictures tried, backwards; then all is decoded


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
        upright: What makes the stored pictures upright.
        notes: What is unusual about the file, one sentence each.
        bits: Of a colour of its pictures: 8, or more.
        pixel_aspect: Width of a pixel of the upright pictures over its height.
        projection: What the file says of pictures that are no lens's; None: nothing.
    """

    path: Path
    width: int
    height: int
    codec: str
    duration_s: float | None
    announced_frames: int | None
    fps: float | None
    has_audio: bool
    upright: Upright
    notes: tuple[str, ...] = ()
    bits: int = 8
    pixel_aspect: float = 1.0
    projection: Projection | None = None


@dataclass(frozen=True)
class VideoFrame:
    """One decoded picture; its colours are made when they are asked for.

    Attributes:
        index: Place in presentation order, from 0.
        time_s: File time.
        picture: As stored, before its turn.
        upright: What makes it upright.
    """

    index: int
    time_s: float
    picture: av.VideoFrame
    upright: Upright

    @property
    def rgb(self) -> UInt8[np.ndarray, "height width 3"]:
        """Upright, R, G, B."""
        return cv2.cvtColor(self.bgr, cv2.COLOR_BGR2RGB)

    @property
    def bgr(self) -> UInt8[np.ndarray, "height width 3"]:
        """Upright, B, G, R: what OpenCV writes."""
        return self.upright.apply(bgr_of(self.picture))

    def stored_grey(self, side_px: int) -> UInt8[np.ndarray, "small_height small_width"]:
        """Grey, area-averaged to at most `side_px`; rows in the order the sensor reads them, so not turned."""
        return small_luma(self.picture, side_px)

    def stored_rgb(self, side_px: int) -> UInt8[np.ndarray, "small_height small_width 3"]:
        """R, G, B, area-averaged to at most `side_px`, not turned either; a few times the cost of `stored_grey`."""
        return small_rgb(self.picture, side_px)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, upright."""
        return self.upright.size(self.picture.width, self.picture.height)

    @property
    def damaged(self) -> bool:
        """Whether the decoder had to fill in what could not be read."""
        return self.picture.is_corrupt


def probe_video(path: Path) -> VideoInfo:
    """Look at a video file without reading all of it; its first picture must decode.

    Raises:
        InputError: If the file is missing, empty, not a video, or has no picture that decodes.
    """
    with VideoReader(path) as reader:
        return reader.info


class VideoReader:
    """Streams the pictures of one file: `with VideoReader(path) as reader: for frame in reader: ...`.

    Only the decoder's few pictures are held. `info` is known at once; after the loop `decoded` is the number of
    pictures and `ended_early` says in words where a damaged or truncated file ended (None for a whole one).
    """

    def __init__(self, path: Path, from_s: float | None = None, threads: int | None = None) -> None:
        """Open `path` and decode a first picture.

        Args:
            path: The file.
            from_s: Leave out pictures before this file time. The reader jumps to a key picture before it and decodes
                from there: times, indices and pictures are those of reading from the start.
            threads: Of the decoder, as `video_stream` takes them.
        Raises:
            InputError: If the file is missing, empty, not a video, or has no picture that decodes.
        """
        self.path = Path(path)
        self.decoded = 0
        self.ended_early: str | None = None
        self._from_s = from_s
        self._threads = threads
        self._packets: Packets | None = None  # known where the reader jumped
        if from_s is None or not self._open_at(from_s):
            self._open()
            if self._first is None:
                reason = self._failure or "the video stream is empty"
                self._container.close()
                wrong = f"{self.path}: no picture decodes ({reason}); expected at least one"
                raise InputError("video-unreadable", f"{wrong}; record the clip again or leave it out")
        try:
            assert self._first is not None
            self.info = self._describe(self._first)
        except BaseException:
            self._container.close()
            raise

    def _open(self, at_pts: int | None = None) -> None:
        self._failure: str | None = None
        self._container = open_media(self.path)
        try:
            self._stream = video_stream(self._container, self.path, self._threads)
            self._origin_s = origin_s(self._container)
            if at_pts is not None:
                self._container.seek(at_pts, stream=self._stream)
            self._pictures = self._decode()
            self._first = next(self._pictures, None)
        except BaseException:
            self._container.close()
            raise

    def _open_at(self, from_s: float) -> bool:
        """Jump to a key picture from which `from_s` can be decoded; False where that cannot be done exactly."""
        packets = scan_packets(self.path)
        with open_media(self.path) as container:
            time_base = video_stream(container, self.path).time_base
            start_s = from_s + origin_s(container)
            exact = container.format.name not in CODING_ORDER_FORMATS
        if not exact or time_base is None or packets.pts is None or len(packets.pts) == 0:
            return False
        from_pts = max(int(packets.pts[0]), int(start_s / time_base))
        # Pictures shown before the key picture they are coded after need the one before it (open groups).
        for key_pts in packets.keys[packets.keys <= from_pts][: -1 - SEEK_TRIES : -1]:
            try:
                self._open(int(key_pts))
            except FFmpegError:  # a format without an index
                return False
            landed = None if self._first is None else self._first.pts
            place = None if landed is None or landed > from_pts else packets.index_of(landed)
            if place is not None:
                self._packets, self.decoded = packets, place
                return True
            self._container.close()
        return False

    def __enter__(self) -> "VideoReader":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._container.close()

    def __iter__(self) -> Iterator[VideoFrame]:
        """Yield every picture that decodes, in presentation order. Can be run through once.

        Raises:
            CaptureError: If a picture carries no timestamp, or one that is hours off.
        """
        first_s = None
        picture, self._first = self._first, None
        if picture is None:
            raise ValueError(f"{self.path}: a VideoReader can be read only once")
        shown = self._shown_pts()
        while picture is not None:
            pts = picture.pts if shown is None or self.decoded >= len(shown) else int(shown[self.decoded])
            if pts is None or self._stream.time_base is None:
                wrong = (
                    f"{self.path}: frame {self.decoded} has no timestamp (a raw stream without container?)"
                )
                remedy = "put it into an mp4 with the true frame rate: `ffmpeg -r 30 -i in.h264 out.mp4`"
                raise CaptureError("times-missing", f"{wrong}; {remedy}")
            time_s = float(pts * self._stream.time_base) - self._origin_s  # flushed ones know no unit
            first_s = time_s if first_s is None else first_s
            check_span(self.path, abs(time_s - first_s))
            place = None if self._packets is None else self._packets.index_of(pts)
            if place is not None:  # after a jump some pictures before the key picture do not decode
                self.decoded = place
            if self._from_s is None or time_s >= self._from_s:
                yield VideoFrame(self.decoded, time_s, picture, self.info.upright)
            self.decoded += 1
            picture = next(self._pictures, None)
            if picture is None:
                self.ended_early = self._early_end(time_s)

    def _shown_pts(self) -> Int[np.ndarray, " n"] | None:
        """Timestamps in the order in which pictures are shown, where the pictures' own are in another."""
        reordered = (
            self._container.format.name in CODING_ORDER_FORMATS and self._stream.codec_context.has_b_frames
        )
        return scan_packets(self.path).pts if reordered else None

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
        matrix = _side(picture, "DISPLAYMATRIX")
        upright = Upright() if matrix is None else by_display_matrix(matrix)
        width, height = upright.size(picture.width, picture.height)
        notes = []
        if not upright.nothing:
            notes.append(f"pictures are {upright.words} as the file says")
        others = [s for s in video_streams(container) if s.index != stream.index]
        if others:
            sizes = ", ".join(
                f"{s.codec_context.width}x{s.codec_context.height}" for s in others if s.codec_context
            )
            mine = f"the largest is used, number {stream.index}"
            notes.append(f"{1 + len(others)} streams of pictures: {mine}, not {sizes or 'the others'}")
        aspect = stream.sample_aspect_ratio or Fraction(1)
        if aspect != 1:
            stored = f"{aspect.numerator}:{aspect.denominator}"
            notes.append(
                f"pixels are not square ({stored}); left as they are, the lens has a focal length each way"
            )
        if picture.interlaced_frame:
            notes.append("pictures are interlaced: fast motion shows combs; film in a progressive mode")
        transfer = hdr_transfer(picture)
        if transfer is not None:
            notes.append(f"HDR video ({transfer}): reference white becomes 255, brighter light is clipped")
        elif (wide := wide_primaries(picture)) is not None:
            notes.append(f"pictures are brought from {NAMES[wide]} to sRGB")
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
            upright=upright,
            notes=tuple(notes),
            bits=bits_of(picture),
            pixel_aspect=float(1 / aspect if upright.quarters % 2 else aspect),
            projection=of_sphere(_side(picture, "SPHERICAL"), _side(picture, "STEREO3D")),
        )


def _side(picture: av.VideoFrame, kind: str) -> bytes | None:
    """What comes beside a picture, of a kind that FFmpeg knows; None without."""
    found = picture.side_data.get(kind)
    return None if found is None else bytes(found)
