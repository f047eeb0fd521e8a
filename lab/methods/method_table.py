"""The methods by name, and what is known of each where it was published."""

from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Literal

from devrf.capture.system.errors import InputError

if TYPE_CHECKING:  # a command that lists names does not need torch
    from devrf.lab.methods.protocol import Method

Regime = Literal["joint", "two-stage", "dynamic"]
"""What is trained on: sweep and moving cameras together; first the sweep, then the moving cameras; the latter alone."""

Size = Literal["small", "full"]
"""Widths: reduced for a CPU, or those that were published."""


@dataclass(frozen=True)
class ListedMethod:
    """A method.

    Attributes:
        about: In a few words.
        module, name: Where it is; imported when it is asked for.
        paper: Where it was published.
        parameters: Of networks of the published widths, millions, counted by hand; None: it depends on the scene.
    """

    about: str
    module: str
    name: str
    paper: str
    parameters: float | None = None

    def load(self) -> "Method":
        """The method itself.

        Raises:
            InputError: A package that it needs is not installed.
        """
        try:
            return getattr(import_module(f"devrf.lab.methods.{self.module}"), self.name)
        except ModuleNotFoundError as error:
            text = f"this method needs {error.name}, which is not installed: python -m pip install 'devrf[methods]'"
            raise InputError("package-missing", text) from error


METHODS: dict[str, ListedMethod] = {
    "d-nerf": ListedMethod(
        "a network moves points to a canonical NeRF", "d_nerf", "METHOD", "Pumarola et al., CVPR 2021", 1.1
    ),
    "nerfies": ListedMethod(
        "a field of rigid motions, coarse to fine", "nerfies", "METHOD", "Park et al., ICCV 2021", 0.7
    ),
    "hyper-nerf": ListedMethod(
        "Nerfies with a template in five dimensions",
        "hyper_nerf",
        "METHOD",
        "Park et al., SIGGRAPH Asia 2021",
        0.8,
    ),
    "nsff": ListedMethod(
        "a field in four dimensions with scene flow", "nsff", "METHOD", "Li et al., CVPR 2021", 1.2
    ),
    "neural-volumes": ListedMethod(
        "a decoder of a volume and its warps", "neural_volumes", "METHOD", "Lombardi et al., SIGGRAPH 2019"
    ),
    "hex-plane": ListedMethod(
        "products of planes of space and time", "planes", "HEX_PLANE", "Cao and Johnson, CVPR 2023"
    ),
    "k-planes": ListedMethod(
        "products of all planes, at several resolutions",
        "planes",
        "K_PLANES",
        "Fridovich-Keil et al., CVPR 2023",
    ),
    "gaussians": ListedMethod(
        "Gaussians that a network moves", "gaussians", "METHOD", "Yang et al., CVPR 2024"
    ),
    "devrf-tiny": ListedMethod("DeVRF, preset tiny", "devrf", "TINY", "Liu et al., NeurIPS 2022"),
    "devrf-fast": ListedMethod("DeVRF, preset fast", "devrf", "FAST", "Liu et al., NeurIPS 2022"),
    "devrf-reference": ListedMethod(
        "DeVRF, preset reference", "devrf", "REFERENCE", "Liu et al., NeurIPS 2022"
    ),
}
OURS = "devrf-fast"  # whose quality the others are timed to reach
