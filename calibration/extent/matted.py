"""A scene's pictures with their mattes, and where these say that the subject ever is."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

import numpy as np

from devrf.calibration.extent.motion_masks import MotionMask
from devrf.capture.camera import Camera
from devrf.capture.mattes.given import SWEEP
from devrf.capture.mattes.make import CameraMattes
from devrf.capture.scene import PosedFrame
from devrf.capture.system.spread import spread

HULL_PICTURES = 24  # of a sweep, for the box


@dataclass(frozen=True)
class SceneMattes:
    """The pictures with their mattes.

    Attributes:
        static, dynamic: The scene's pictures.
        cameras: Name -> what was made.
        small: Name -> the cameras of its pictures at the size of `MatteFacts.small`, in order.
        everywhere: Every picture has one, so that the subject can be modelled before a plain background.
    """

    static: tuple[PosedFrame, ...]
    dynamic: tuple[PosedFrame, ...]
    cameras: Mapping[str, CameraMattes]
    small: Mapping[str, list[Camera]]
    everywhere: bool

    def only(self, names: Collection[str]) -> "SceneMattes":
        """Those of some cameras."""
        cameras, small = (
            {name: of[name] for name in of if name in names} for of in (self.cameras, self.small)
        )
        return replace(self, cameras=cameras, small=small)

    @property
    def hull_masks(self) -> list[MotionMask]:
        """Where the subject ever is, by the moving cameras; by the sweep where there are not two of them."""
        moving = [
            MotionMask(self.small[name][0], np.any([fact.small for fact in made.facts], axis=0))
            for name, made in self.cameras.items()
            if name != SWEEP
        ]
        if len(moving) > 1 or SWEEP not in self.cameras:
            return moving
        facts, cameras = self.cameras[SWEEP].facts, self.small[SWEEP]
        chosen = spread(list(zip(cameras, facts, strict=True)), HULL_PICTURES)
        return [MotionMask(camera, fact.small) for camera, fact in chosen]
