"""What a clip's coded pictures tell without being decoded: how many, when, how many bytes. Reading them is fast.

A packet holds a picture, or one field of an interlaced one (`interlaced.py`).
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from av.error import FFmpegError
from jaxtyping import Int

from devrf.capture.system.limits import check_span
from devrf.capture.video.interlaced import SecondFields
from devrf.capture.video.media import open_media, video_stream


@dataclass(frozen=True)
class Packets:
    """The coded pictures that are really in a file.

    Attributes:
        count: Their number, up to the first damage.
        size_bytes: Their size together.
        pts: Timestamps of those that are shown [n], sorted, in the stream's time base; None where some carry none.
        keys: Timestamps of key pictures [m], rising; also of those that an edit list hides.
    """

    count: int
    size_bytes: int
    pts: Int[np.ndarray, " n"] | None
    keys: Int[np.ndarray, " m"]

    def index_of(self, pts: int) -> int | None:
        """Place in presentation order of the picture with this timestamp; None where none or several have it."""
        if self.pts is None:
            return None
        places = np.flatnonzero(self.pts == pts)
        return int(places[0]) if len(places) == 1 else None


def scan_packets(path: Path) -> Packets:
    """Read the packets of a clip's pictures: of the stream that `video_stream` takes.

    Raises:
        InputError: If the file is not a video.
        CaptureError: If its times lie further apart than any recording is long.
    """
    with open_media(path) as container:
        stream = video_stream(container, path)
        fields = SecondFields(stream.codec_context.name, stream.codec_context.extradata)
        count, size_bytes = 0, 0
        pts: list[int] = []
        keys: list[int] = []
        timed = True
        try:
            for packet in container.demux(stream):
                if packet.is_corrupt:
                    break
                second = fields.possible and fields.second(bytes(packet))
                if packet.is_keyframe and packet.pts is not None and not second:
                    keys.append(packet.pts)
                if packet.size == 0 or packet.is_discard:  # the end; before the start of an edit list
                    continue
                size_bytes += packet.size
                if second:
                    continue
                count += 1
                if packet.pts is None:
                    timed = False
                else:
                    pts.append(packet.pts)
        except FFmpegError:
            pass  # what is before the damage counts
        if pts and stream.time_base is not None:
            check_span(path, float((max(pts) - min(pts)) * stream.time_base))
    shown = np.array(sorted(pts), dtype=np.int64) if timed else None
    return Packets(count, size_bytes, shown, np.array(sorted(keys), dtype=np.int64))
