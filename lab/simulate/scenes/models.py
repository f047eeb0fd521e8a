"""The models that data sets are made of, by name."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from devrf.lab.simulate.scenes.growths import flower, glove
from devrf.lab.simulate.scenes.machines import arm, robot, vehicle
from devrf.lab.simulate.scenes.shapes import Model


@dataclass(frozen=True)
class ModelKind:
    """A model to choose.

    Attributes:
        about: What it is and does, in a few words.
        build: From a random generator and the relative size of the motion to the model.
        face_deg: Azimuth from which it is best seen, for cameras that all look the same way.
    """

    about: str
    build: Callable[[np.random.Generator, float], Model]
    face_deg: float


MODELS = {
    "vehicle": ModelKind("a toy dump truck that tilts its bed, steers and turns its wheels", vehicle, -60.0),
    "robot": ModelKind("a toy robot whose rigid parts drift and turn apart", robot, -20.0),
    "flower": ModelKind("a flower in a pot that bends and opens", flower, -50.0),
    "glove": ModelKind("a hand in a glove that closes to a fist", glove, -70.0),
    "arm": ModelKind("a robot arm that swings, reaches out and closes its gripper", arm, -75.0),
}
