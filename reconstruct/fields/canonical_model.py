"""What stage 1 leaves and everything after it begins with: the scene at rest and its surroundings."""

from dataclasses import asdict, dataclass
from typing import Any

from devrf.capture.camera import Camera
from devrf.reconstruct.fields.canonical import NUMBERS, Canonical, ColourNet
from devrf.reconstruct.fields.contracted_background import Shell
from devrf.reconstruct.fields.near_plane import near_plane


@dataclass
class RestModel:
    """The scene at rest, its surroundings (None before a plain background), its log."""

    canonical: Canonical
    shell: Shell | None
    background: str
    near: float
    far: float
    metrics: dict[str, Any]

    def near_for(self, camera: Camera) -> float:
        """Where a camera's surroundings begin, `near` or farther; the camera is in the box frame."""
        if self.shell is None:
            return self.near
        return near_plane(camera, self.shell.points, self.canonical.aabb, self.near)

    def numbers(self) -> dict[str, Any]:
        """All of it that is no tensor, as JSON has it: what files of models and of trainings keep.

        Raises:
            ValueError: A coarse model without an MLP, which is not kept.
        """
        canonical, shell, net = self.canonical, self.shell, self.canonical.net
        if not isinstance(net, ColourNet):
            raise ValueError("a coarse model without an MLP is not saved")
        out: dict[str, Any] = {
            "canonical": {name: getattr(canonical, name) for name in NUMBERS},
            "shape": canonical.shape,
            "channels": canonical.features.shape[3],
            "mlp_width": net.hidden.out_features,
            "view_frequencies": net.frequencies,
            "deferred": canonical.deferred,
            "ndc": asdict(canonical.ndc) if canonical.ndc is not None else None,
            "background": self.background,
            "near": self.near,
            "far": self.far,
        }
        if shell is not None:
            out["shell"] = {name: getattr(shell, name) for name in ("size", "final", "near")}
            out["shell"] |= asdict(shell.contraction)
        return out
