"""What others report of methods for moving scenes: on other data and other devices, for orientation only.

Of ranges the better end is taken; where two groups measured one method, its authors.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Published:
    """One method's own figures; None where none was found.

    Attributes:
        name: Method and year.
        psnr: dB.
        seconds: Of training.
        megabytes: Of the model.
        fps: Pictures per second.
        on: Data and device.
    """

    name: str
    psnr: float
    seconds: float | None
    megabytes: float | None
    fps: float | None
    on: str


D_NERF = "D-NeRF's eight synthetic scenes, 800x800, one moving camera"
PUBLISHED = (
    Published("DeVRF 2022", 34.29, 540.0, 2500.0, 1.1, "its five synthetic scenes, 400x400, RTX 3090"),
    Published("TiNeuVox-S 2022", 30.75, 480.0, 8.0, 1.5, D_NERF),
    Published("TiNeuVox-B 2022", 32.67, 1680.0, 48.0, 1.5, D_NERF),
    Published("TiNeuVox, nerfacc 2023", 32.42, 346.0, None, None, f"{D_NERF}, RTX 2080 Ti"),
    Published("K-Planes 2023", 31.61, 3120.0, 418.0, 1.2, D_NERF),
    Published("HexPlane-Slim 2023", 31.04, 690.0, 38.0, 2.5, D_NERF),
    Published("MSTH 2023", 31.34, 360.0, None, None, D_NERF),
    Published("4DGaussians 2024", 34.05, 480.0, 18.0, 82.0, f"{D_NERF}, RTX 3090"),
    Published("4DGS-1K 2025", 33.34, None, 42.0, 1462.0, f"{D_NERF}, RTX 3090"),
    Published("P-4DGS 2025", 38.10, None, 1.04, 262.0, D_NERF),
)
