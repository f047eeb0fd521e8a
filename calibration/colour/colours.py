"""What is known of every camera's colours, on disk: colour.json, and beside it gains by frame."""

from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Int

from devrf.calibration.colour.match import Apart
from devrf.capture.colour.correction import EVEN, SAME, Gains, Look, Matrix, as_gains
from devrf.capture.system.arrays import read_npy
from devrf.capture.system.durable import read_json, write_json
from devrf.capture.system.errors import CaptureError

Source = Literal["reference", "points", "none"]
FILE = "colour.json"


@dataclass(frozen=True)
class CameraColour:
    """One camera.

    Attributes:
        source: What its correction comes from; `none`: it has none.
        kind: What was fitted: none, gain, diagonal or matrix.
        matrix: Linear light of the reference from its own.
        stops, stops_std: By how much it is brighter than the reference, and how sure; None where not known.
        fitted: Points that were fitted.
        apart: How far it lies from the cameras it was compared with, on points kept out of the fit.
        gains: Its gains' file beside colour.json, rows of frame, R, G, B; None where its light is steady.
    """

    source: Source
    kind: str = "none"
    matrix: Matrix = SAME
    stops: float | None = None
    stops_std: float | None = None
    fitted: int = 0
    apart: Apart = field(default_factory=lambda: Apart(0, None, None))
    gains: str | None = None


@dataclass(frozen=True)
class Colours:
    """All cameras, the sweep's too.

    Attributes:
        folder: Where the files lie.
        reference: Camera that the others are brought to; None where nothing was matched.
        cameras: Name -> its colours.
        total: How far the corrected cameras lie apart, over all pairs that were compared.
    """

    folder: Path
    reference: str | None
    cameras: dict[str, CameraColour]
    total: Apart

    def look(self, name: str, frame: int) -> Look | None:
        """The look of a frame of a camera; None where nothing is to be changed."""
        camera = self.cameras.get(name)
        if camera is None:
            return None
        look = Look(camera.matrix, self.steady(name, frame))
        return look if look.changes else None

    def before_matching(self, name: str, frame: int) -> Look:
        """What makes up for unsteady light alone."""
        return Look(gains=self.steady(name, frame))

    def steady(self, name: str, frame: int) -> Gains:
        """Gains that bring a frame to its clip's usual light."""
        if name not in self._gains:
            return EVEN
        index, gains = self._gains[name]
        return as_gains(gains[int(np.argmin(np.abs(index - frame)))])

    @cached_property
    def _gains(self) -> dict[str, tuple[Int[np.ndarray, " n"], Float[np.ndarray, "n 3"]]]:
        tables = {n: read_npy(self.folder / c.gains) for n, c in self.cameras.items() if c.gains is not None}
        return {name: (table[:, 0].astype(int), table[:, 1:]) for name, table in tables.items()}

    def write(self) -> None:
        """Write colour.json into the folder."""
        content = {
            "reference": self.reference,
            "total": asdict(self.total),
            "cameras": {name: asdict(camera) for name, camera in self.cameras.items()},
        }
        write_json(self.folder / FILE, content)


def read_colours(folder: Path) -> Colours:
    """Read what `Colours.write` wrote.

    Raises:
        CaptureError: It is missing or damaged.
    """
    path = folder / FILE
    try:
        content = read_json(path)
        cameras = {name: _camera(entry) for name, entry in content["cameras"].items()}
        return Colours(folder, content["reference"], cameras, Apart(**content["total"]))
    except (OSError, ValueError, KeyError, TypeError) as error:
        text = f"{path}: cannot be read ({error!r}); run again with --from colour"
        raise CaptureError("file-damaged", text) from None


def _camera(entry: dict[str, Any]) -> CameraColour:
    matrix = tuple(tuple(float(v) for v in row) for row in entry["matrix"])
    return CameraColour(**{**entry, "matrix": matrix, "apart": Apart(**entry["apart"])})
