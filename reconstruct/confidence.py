"""How wrong a rendered picture is expected to be, pixel by pixel: never by looking at a true picture of that view.

The expected squared error is a sum of causes (`error_causes.py`), each with a factor that is not negative: nothing
becomes surer by being seen less, or explained worse. The factors are fitted to the errors of a few training
pictures, their own camera's differences left out of what is known, as a generalised linear model with gamma errors
(McCullagh & Nelder, Generalized Linear Models, 1989, ch. 8): the scatter of a squared error grows with it.

What is displaced can be no more wrong than what has nothing to do with it. Where pictures are fitted this bounds the
causes before their factors, in a view after them, smoothly. That is no oversight: training explains its own pictures
even where a point may be anywhere, so that bounded alike `place` loses its factor, or the most that it can say, and
parts that nobody saw count hardly more than others (measured: docs/stability.md).
"""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64
from scipy.optimize import nnls

from devrf.capture.camera import Camera
from devrf.capture.scene import PosedFrame, Scene, load_image
from devrf.reconstruct.error_causes import (
    CAUSES,
    DISPLACED,
    Ground,
    Layers,
    Surface,
    causes,
    most_displaced,
    slope,
    surface_of,
)
from devrf.reconstruct.evidence import Evidence
from devrf.reconstruct.model import DynamicModel, render_layers
from devrf.reconstruct.pictures import clips, spread, training

FORMAT = 1
FITTED_ON = 4  # training pictures; where something moves, all but one of them show it
FIT_PIXELS = 5_000  # of each of them
FIT_STEPS = 12
LEAST = 1e-5  # a squared error of a grey level: less cannot be told from rounding


@dataclass(frozen=True)
class ErrorBudget:
    """What was learned: what holds for all pictures, and the causes' factors.

    Attributes:
        ground: Measured on the training pictures.
        factors: By cause.
        fitted_on: Camera and index of the pictures that the factors were fitted on.
    """

    ground: Ground
    factors: dict[str, float]
    fitted_on: tuple[tuple[str, int], ...]

    def save(self, path: Path) -> None:
        """Write as JSON."""
        path.write_text(json.dumps({"format": FORMAT, **asdict(self)}, indent=1, allow_nan=False) + "\n")


class Confidence:
    """Expected errors of pictures of a model.

    Args:
        scene: Only its training pictures are read; cameras in any frame.
        model: As it is rendered.
    Attributes:
        evidence: What the training pictures know.
        budget: What was learned of their errors.
    """

    def __init__(self, scene: Scene, model: DynamicModel) -> None:
        scene = scene.in_box_frame()
        self.model, self.evidence = model, Evidence(scene, model)
        self.budget = _learn(scene, self.evidence, _chosen(scene, model.motion is not None))

    def render(self, camera: Camera, time: float | None) -> Layers:
        """RGB, depth and opacity of a camera in the box frame at a time in [0, 1]; None: the scene at rest."""
        return render_layers(self.model, camera, time)

    def expected(self, camera: Camera, time: float | None, layers: Layers) -> Float32[np.ndarray, "h w"]:
        """Root of each pixel's expected squared error (mean over channels), of the full range.

        Args:
            camera, time: As rendered.
            layers: What `render` gave.
        """
        return self.expected_of(surface_of(self.evidence, camera, time, layers), camera, layers)

    def expected_of(self, surface: Surface, camera: Camera, layers: Layers) -> Float32[np.ndarray, "h w"]:
        """The same, of a surface that has been looked up."""
        ground, factors = self.budget.ground, self.budget.factors
        parts = causes(surface, camera, layers, ground) * [factors[name] for name in CAUSES]
        displaced = parts[..., DISPLACED].sum(-1) / most_displaced(layers, ground)
        parts[..., DISPLACED] /= 1 + displaced[..., None]
        return np.sqrt(np.clip(parts.sum(-1), LEAST, 1.0)).astype(np.float32)


def _chosen(scene: Scene, moves: bool) -> list[PosedFrame]:
    """Training pictures to fit on: of the moving cameras in turn, at times spread over the clip, and of the sweep."""
    rest, moving = training(scene.static), list(clips(scene).values()) if moves else []
    if not moving:
        return spread(rest, FITTED_ON)
    count = FITTED_ON - 1 if rest else FITTED_ON
    chosen = []
    for n in range(count):
        clip = moving[n * len(moving) // count % len(moving)]
        chosen.append(clip[int((n + 0.5) / count * len(clip))])
    return chosen + rest[len(rest) // 2 :][:1]


def _learn(scene: Scene, evidence: Evidence, frames: Sequence[PosedFrame]) -> ErrorBudget:
    textures, unrelated = [], []
    for frame in frames:
        true = _true(scene, frame)
        textures.append(slope(true).mean())
        unrelated.append(2 * true.reshape(-1, 3).var(axis=0).mean())
    ground = Ground(
        texture=float(np.mean(textures)),
        focal_px=float(np.mean([frame.camera.scaled(scene.image_scale).K[0, 0] for frame in frames])),
        unrelated=float(np.mean(unrelated)) + LEAST,
        sweep=_mean_residual(evidence.sweep),
        motion=_mean_residual([w for witnesses in evidence.fixed.values() for w in witnesses]),
    )
    terms, errors = zip(*(_some_pixels(scene, evidence, ground, frame) for frame in frames), strict=True)
    fitted = _fit(np.concatenate(terms), np.concatenate(errors).astype(np.float64))
    factors: dict[str, float] = dict(zip(CAUSES, fitted.tolist(), strict=True))
    return ErrorBudget(ground, factors, tuple((f.camera_name, f.index) for f in frames))


def _true(scene: Scene, frame: PosedFrame) -> Float32[np.ndarray, "h w 3"]:
    return load_image(frame, scene.image_scale, scene.background).astype(np.float32) / 255


def _some_pixels(
    scene: Scene, evidence: Evidence, ground: Ground, frame: PosedFrame
) -> tuple[Float64[np.ndarray, "n causes"], Float32[np.ndarray, " n"]]:
    """Causes and squared errors of every n-th pixel of a training picture; what is kept of it is only these."""
    camera, true = frame.camera.scaled(scene.image_scale), _true(scene, frame)
    layers = render_layers(evidence.model, camera, frame.time)
    surface = surface_of(evidence, camera, frame.time, layers, besides=frame)
    every = -(-true[..., 0].size // FIT_PIXELS)
    found = causes(surface, camera, layers, ground)
    most = most_displaced(layers, ground)[..., None]
    found[..., DISPLACED] = np.minimum(found[..., DISPLACED], most)
    error = ((layers[0] - true) ** 2).mean(-1)
    return found.reshape(-1, len(CAUSES))[::every].copy(), error.reshape(-1)[::every].copy()


def _fit(x: Float64[np.ndarray, "n causes"], y: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " causes"]:
    """Factors >= 0 with x @ factors the mean of y, for errors of y in proportion to its mean (reweighted NNLS)."""
    unit = np.maximum(x.mean(axis=0), 1e-12)
    mean = np.full(len(y), max(float(y.mean()), LEAST))
    factors = np.zeros(x.shape[1])
    for _ in range(FIT_STEPS):
        weighted = x / unit / mean[:, None]
        factors, _ = nnls(weighted, y / mean)
        mean = np.maximum(x / unit @ factors, LEAST)
    return factors / unit


def _mean_residual(witnesses: Sequence) -> float:
    return float(np.mean([w.residual.mean() for w in witnesses])) if witnesses else 0.0
