"""The trained model that is exported as geometry: its world, its times, and what is said of both beside the files."""

import textwrap
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from devrf.calibration.extent.bounds import upright
from devrf.capture.formats import read_scene
from devrf.capture.formats.parts.export import README
from devrf.capture.system.durable import write_json
from devrf.capture.system.errors import InputError
from devrf.pipelines.export import times
from devrf.pipelines.export.request import Request
from devrf.pipelines.export.times import ExportTime
from devrf.pipelines.inputs.device import resolve_device
from devrf.pipelines.stamps.stamp import STAMP
from devrf.reconstruct.sampling.pictures import training

if TYPE_CHECKING:  # it needs torch
    from devrf.reconstruct.rendering.model import DynamicModel

FACTS = "export.json"
AXES = (
    "the world of the calibration, the same as in the data set exports of this run. None of its axes is up by rule; "
    "`up` in export.json is the direction that the cameras were held by."
)


class ExportedModel:
    """The model of a run, and the world it is exported into.

    Attributes:
        request: What was asked for.
        scene: In the world of the calibration, which is that of all exports.
        boxed: The same in the box frame, which is the model's.
        model: The model.
        moments: The times that were asked for; the scene at rest alone where nothing moves.
    """

    def __init__(self, request: Request, default_times: str) -> None:
        """Load what a request needs.

        Args:
            request: What was asked for.
            default_times: `--times` where it was not given.
        Raises:
            InputError: Times that are not understood, outside the clip, or of a scene in which nothing moves.
            ReconstructError: The model cannot be read.
        """
        self.request = request
        self.scene = read_scene(request.run_dir / "scene")
        self.boxed = self.scene.in_box_frame()
        wish, moved = request.options.times, (request.run_dir / "deformation" / STAMP).is_file()
        if not moved and wish is not None:
            why = (
                "its motion is not trained yet (--until deformation)"
                if self.scene.dynamic
                else "nothing moves in it"
            )
            text = f"--times {wish}: the scene has no times to choose from: {why}"
            raise InputError("option-misplaced", text)
        if not moved and self.scene.dynamic:
            request.notes.append("the motion is not trained yet: this is the scene at rest alone")
        from devrf.reconstruct.rendering.model import moments_of
        from devrf.reconstruct.storage.model_io import load_model

        device = resolve_device(request.options.device or "auto")
        self.model: DynamicModel = load_model(request.run_dir, device)
        self.moments: list[ExportTime] = [times.REST]
        if keys := moments_of(self.model):
            self.moments = times.chosen(default_times if wish is None else wish, self.scene, keys)

    @property
    def unit(self) -> str:
        """What lengths are in."""
        return (
            "metres" if self.scene.metric else "units of arbitrary scale (nothing of known length was filmed)"
        )

    @property
    def scale(self) -> float:
        """World units in a unit of the box frame."""
        return float(np.cbrt(np.linalg.det(self.world_from_box[:3, :3])))

    @cached_property
    def world_from_box(self) -> Float[np.ndarray, "4 4"]:
        """Similarity."""
        return np.linalg.inv(self.scene.box_from_world)

    @cached_property
    def upright_from_world(self) -> Float[np.ndarray, "3 3"]:
        """Rotation to axes with z up, and y where the moving cameras look, by how the cameras were held."""
        sweep, fixed = (
            [f.camera for f in training(frames)] for frames in (self.scene.static, self.scene.dynamic)
        )
        return upright(sweep or fixed, fixed or sweep)

    def to_world(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Points of the box frame in the world."""
        return points @ self.world_from_box[:3, :3].T + self.world_from_box[:3, 3]

    def turned_to_world(self, directions: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Unit directions of the box frame in the world."""
        return directions @ (self.world_from_box[:3, :3] / self.scale).T

    def comments(self, what: str, moment: ExportTime) -> list[str]:
        """What stands in the head of a file of one time."""
        return [f"devrf {what} in the world of the calibration", f"unit: {self.unit}", moment.said()]

    def describe(
        self, folder: Path, *, files: str, axes: str, facts: dict[str, Any], lengths: str | None = None
    ) -> None:
        """Write README.txt and export.json.

        Args:
            folder: Of the export.
            files: What lies there, in words.
            axes: Of the files, in words.
            facts: More for programs.
            lengths: What lengths in the files are in; None: the world's.
        """
        up = self.upright_from_world[2]
        paragraphs = [
            f"The trained model of a scene in the format {self.request.name}.",
            f"Files: {files}",
            f"Axes: {axes}",
            f"Scale: lengths are in {lengths or self.unit}.",
        ]
        if self.moments[0].time_s is not None:
            paragraphs.append(
                f"Time: seconds on the first camera's clock; the model spans {self.scene.t0_s:.6f} s to "
                f"{self.scene.t1_s:.6f} s."
            )
        paragraphs += [f"Note: {text}." for text in self.request.notes]
        text = "\n\n".join(textwrap.fill(text, 100) for text in paragraphs)
        (folder / README).write_text(text + "\n")
        value = {
            "format": self.request.name,
            "axes": axes,
            "unit": lengths or ("metre" if self.scene.metric else "arbitrary"),
            "metric": self.scene.metric,
            "up": up.tolist(),
            "world_from_box": self.world_from_box.tolist(),
            "t0_s": self.scene.t0_s,
            "t1_s": self.scene.t1_s,
            "notes": self.request.notes,
            **facts,
        }
        write_json(folder / FACTS, value)


def entry_of(path: Path, moment: ExportTime, xyz: Float[np.ndarray, "n 3"], **facts: int) -> dict[str, Any]:
    """A file of one time, for export.json."""
    return {"file": path.name, "time": moment.time, "time_s": moment.time_s, **facts, **bounds_of(xyz)}


def bounds_of(points: Float[np.ndarray, "n 3"]) -> dict[str, list[float]]:
    """The bounding box of points, for export.json."""
    return {"min": points.min(0).tolist(), "max": points.max(0).tolist()}
