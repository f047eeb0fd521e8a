"""Tiny scenes for the tests of batches: nine views of a textured ball, which the real stages work on in seconds."""

import json
from pathlib import Path

import cv2
import numpy as np

SIZE, VIEWS = 32, 9
SCENE = """
name: {name}
output: run
preset: tiny
dataset: {{format: blender, path: data}}
reconstruct: {{resolution: 16, rays: 64, canonical_iterations: {iterations}}}
"""


def tiny_scene(folder: Path, name: str, iterations: int = 10) -> Path:
    """Write a data set at rest in Blender's layout and its scene.yaml; the path of that."""
    data = folder / name / "data"
    (data / "train").mkdir(parents=True)
    frames = []
    v, u = np.mgrid[:SIZE, :SIZE] + 0.5 - SIZE / 2
    ball = u**2 + v**2 < (SIZE / 3) ** 2
    for n in range(VIEWS):
        angle = 2 * np.pi * n / VIEWS
        shade = 127 + 100 * np.sin(u / 3 + 4 * angle)
        picture = np.stack([shade, 255 - shade, np.full_like(shade, 90), 255.0 * ball], axis=-1)
        cv2.imwrite(str(data / "train" / f"r_{n}.png"), picture.astype(np.uint8))
        z = np.array([np.sin(angle), 0.0, np.cos(angle)])
        pose = np.eye(4)
        pose[:3, :3] = np.stack([np.cross([0.0, 1.0, 0.0], z), [0.0, 1.0, 0.0], z], axis=1)
        pose[:3, 3] = 4.0 * z
        frames.append({"file_path": f"./train/r_{n}", "transform_matrix": pose.tolist()})
    transforms = {"camera_angle_x": 0.7, "frames": frames}
    (data / "transforms_train.json").write_text(json.dumps(transforms))
    scene = folder / name / "scene.yaml"
    scene.write_text(SCENE.format(name=name, iterations=iterations))
    return scene
