"""When clips of the moving scene show it as in the sweep. A file of its own: reading scene.yaml needs no arrays."""

from typing import Literal

Rest = Literal["auto", "start", "middle", "end", "none"]
