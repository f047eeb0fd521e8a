"""Small pictures of the capture, read beside everything else and remembered."""

import logging
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from devrf.capture.errors import DevrfError
from devrf.capture.scene import Background, PosedFrame, load_image

WIDTH = 160  # pixels
KEPT = 600  # 50 kB each
logger = logging.getLogger(__name__)


class Thumbnails:
    """Pictures of frames, by one thread; shared by all visitors."""

    def __init__(self) -> None:
        self._kept: OrderedDict[str, np.ndarray | None] = OrderedDict()
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="thumbnails")

    def soon(self, work: Callable[[], None]) -> None:
        """Do some work with pictures in the thread; nothing once the viewer ends."""
        self._thread.submit(work)

    def of(self, frame: PosedFrame, background: Background) -> np.ndarray | None:
        """A frame's picture [h, w, 3], bytes; None where it cannot be read. For work in the thread."""
        key = str(frame.path)
        if key not in self._kept:
            try:
                self._kept[key] = load_image(frame, min(1.0, WIDTH / frame.camera.width), background)
            except (DevrfError, OSError) as error:
                logger.warning("%s: not shown (%s)", frame.path, error)
                self._kept[key] = None
            while len(self._kept) > KEPT:
                self._kept.popitem(last=False)
        return self._kept[key]

    def end(self) -> None:
        """Do nothing more."""
        self._thread.shutdown(wait=False, cancel_futures=True)
