"""What is simulated, whichever protocol renders it."""

from dataclasses import dataclass
from typing import Generic, TypeVar

from pydantic import BaseModel

Options = TypeVar("Options", bound=BaseModel)


@dataclass(frozen=True)
class Simulation(Generic[Options]):
    """A scene and how it is filmed.

    Attributes:
        scene: Its name.
        cameras: Number of fixed cameras that train, without the witness or test camera.
        seed: Different seeds give other textures and places; of a session other clocks, gains and claps, too.
        size: Width and height of the pictures.
        options: Those of the protocol: everything else.
    """

    scene: str
    cameras: int
    seed: int
    size: tuple[int, int]
    options: Options
