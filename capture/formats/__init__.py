"""Scenes and data sets on disk, in and out: the only place that converts between conventions."""

from devrf.capture.formats.datasets import WRITERS, DatasetFormat, read_dataset, write_dataset
from devrf.capture.formats.parts.opengl import FLIP_YZ
from devrf.capture.formats.parts.scene_files import read_scene, write_scene
from devrf.capture.formats.parts.transforms import read_transforms, write_transforms

__all__ = [
    "FLIP_YZ",
    "WRITERS",
    "DatasetFormat",
    "read_dataset",
    "read_scene",
    "read_transforms",
    "write_dataset",
    "write_scene",
    "write_transforms",
]
