"""devrf: from a field capture of a moving scene to novel views of it (DeVRF, NeurIPS 2022).

The names below are the Python API (docs/api.md). Each is loaded when it is first asked for: this import loads nothing.
"""

import os
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # what editors and type checkers see; `_HOME` says the same at run time
    from devrf.api.reconstruction import Reconstruction, load
    from devrf.api.steps import Calibration, calibrate, ingest, run, train
    from devrf.capture.camera import Camera
    from devrf.capture.frames import CameraFrames as Clip
    from devrf.capture.session import CaptureSession as Session
    from devrf.capture.system.errors import DevrfError
else:

    def __getattr__(name: str) -> Any:
        if name not in _HOME:
            raise AttributeError(
                f"module 'devrf' has no attribute {name!r}; its names are {', '.join(__all__)}"
            )
        module, _, other = _HOME[name].partition(":")
        return getattr(import_module(f"devrf.{module}"), other or name)


__version__ = "0.1.0"
__all__ = [
    "Calibration",
    "Camera",
    "Clip",
    "DevrfError",
    "Reconstruction",
    "Session",
    "calibrate",
    "ingest",
    "load",
    "run",
    "train",
]
_HOME = {
    "Calibration": "api.steps",
    "Camera": "capture.camera",
    "Clip": "capture.frames:CameraFrames",
    "DevrfError": "capture.system.errors",
    "Reconstruction": "api.reconstruction",
    "Session": "capture.session:CaptureSession",
    "calibrate": "api.steps",
    "ingest": "api.steps",
    "load": "api.reconstruction",
    "run": "api.steps",
    "train": "api.steps",
}  # module, and the name there where it is another

# OpenMP reads this once, when torch is loaded, and every way into devrf comes through this file first. Threads that
# busy-wait take five times the processor time beside another program. A value that is set already stands.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
