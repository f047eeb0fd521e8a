"""The README.txt beside an exported data set: axes, scale, time, and what plain readers should know."""

import textwrap

from devrf.capture.scene import Scene

AXES = {
    "nerfstudio": "transform_matrix is camera-to-world with OpenGL's axes: x right, y up, z back. fl_x, fl_y, cx, cy "
    "and the distortion stand per frame; pixel (0, 0) has its centre at (0.5, 0.5).",
    "colmap": "World-to-camera poses with OpenCV's axes: x right, y down, z forward; pixel (0, 0) has its centre at "
    "(0.5, 0.5).",
}
FILES = {
    "nerfstudio": "transforms.json; images/static: the scene at rest; images/<camera>: the scene in motion; "
    "sparse_pc.ply: the sparse points, where there are some.",
    "colmap": "sparse/0 (binary), images/, sparse/0/test.txt (names of the test pictures). Keypoints are where the "
    "points project, points have the mean colour of the pictures, errors are unknown (-1). motion/ is the same for the "
    "pictures in motion (without points), with the fixed cameras as a rig (rigs.bin, frames.bin) and the times of the "
    "pictures in times.csv.",
}


def readme(scene: Scene, dataset_format: str, notes: list[str]) -> str:
    """Text of the file."""
    unit = "metres" if scene.metric else "units of arbitrary scale (nothing of known length was filmed)"
    paragraphs = [
        f"A calibrated scene in the format {dataset_format}.",
        f"Files: {FILES[dataset_format]}",
        f"Axes: {AXES[dataset_format]}",
        f"Scale: positions are in {unit}. The world's axes are those of the calibration; none is up by rule.",
    ]
    if scene.dynamic:
        paragraphs.append(
            f"Time: time 0 is {scene.t0_s:.6f} s and time 1 is {scene.t1_s:.6f} s on the first camera's clock. Every "
            "picture has its own exact time; cameras need not be triggered together."
        )
    paragraphs += [f"Note: {text}." for text in notes]
    paragraphs.append(
        "Read again by devrf with a scene.yaml elsewhere that holds name: NAME and dataset: "
        f"{{format: {dataset_format}, path: THIS FOLDER}}."
    )
    return "\n\n".join(textwrap.fill(text, 100) for text in paragraphs) + "\n"
