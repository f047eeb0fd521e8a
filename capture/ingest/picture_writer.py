"""Write pictures of a clip beside the decoding of the next ones, with a bounded number in flight.

Pictures are stored as JPEG of quality 95 with halved colour, as nearly all video has it: a tenth of the time of
writing PNG and a fifth of its size. Board corners stay where they were within 0.04 px (root mean square), and against
what was filmed the pictures are as good as the decoded ones (docs/ingest.md).
"""

from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from types import TracebackType

from devrf.capture.photos.upright_pictures import write_bgr
from devrf.capture.system.cores import usable_cores
from devrf.capture.video.reader import VideoFrame
from devrf.capture.video.video_jpeg import jpeg_of

SUFFIX = ".jpg"
JPEG_QUALITY = 95


class PictureWriter:
    """`with PictureWriter() as writer: writer.put(path, frame)`; all are written when the block ends.

    A picture that cannot be written (a full disk) is an OSError of a later `put` or of the end.

    Args:
        workers: Pictures written at once; None: one per core.
    """

    def __init__(self, workers: int | None = None) -> None:
        workers = workers or usable_cores()
        self._pool = ThreadPoolExecutor(workers)
        self._most = workers + 1  # one more waits, so that no worker does
        self._writing: deque[Future[None]] = deque()

    def __enter__(self) -> "PictureWriter":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._pool.shutdown(cancel_futures=error is not None)
        if error is None:
            for job in self._writing:
                job.result()

    def put(self, path: Path, frame: VideoFrame) -> None:
        """Write `frame` to `path`, soon; waits while too many are being written."""
        while len(self._writing) >= self._most:
            self._writing.popleft().result()
        self._writing.append(self._pool.submit(_write, path, frame))


def _write(path: Path, frame: VideoFrame) -> None:
    data = jpeg_of(frame.picture, JPEG_QUALITY, frame.upright)
    if data is None:
        write_bgr(path, frame.bgr, JPEG_QUALITY)
    else:
        path.write_bytes(data)
