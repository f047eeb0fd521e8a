"""What the scripts here share: their arguments, cameras beside the truth, and what becomes of their rows."""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from devrf.calibration.truth import Truth
from devrf.capture.scene import Scene
from devrf.lab.bench.bench_rows import Row, publish
from devrf.pipelines.stages.evaluate import versions
from devrf.pipelines.terminal.console import Talk


def arguments(about: str | None, *paths: str, **options: Any) -> argparse.Namespace:
    """Paths, options with their defaults (`device="auto"`), and --json FILE."""
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in paths:
        parser.add_argument(name, type=Path)
    for name, default in options.items():
        parser.add_argument(f"--{name}", default=default, type=str if default is None else type(default))
    parser.add_argument("--json", type=Path)
    return parser.parse_args()


def centres(scene: Scene, truth: Truth) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Places of all cameras of a simulated session, each once: as they were recovered, and as they truly are."""
    fixed = {f.camera_name: f.camera for f in scene.dynamic}
    pairs = [(f.camera, truth.static[f.index]) for f in scene.static]
    pairs += [(camera, truth.cameras[name]) for name, camera in fixed.items()]
    return np.array([c.centre for c, _ in pairs]), np.array([pose[:3, 3] for _, pose in pairs])


def finish(name: str, rows: Sequence[Row], json: Path | None, **about: Any) -> None:
    """Print the rows; write them where asked to."""
    publish(Talk(), name, rows, json, benchmark=name, versions=versions(), **about)
