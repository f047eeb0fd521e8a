"""Which pictures a key time is trained on."""

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from devrf.capture.system.errors import ReconstructError
from devrf.reconstruct.adapt.key_times import AT_KEY

LEAST_SAY = 0.25  # a key's share in a picture, for the key to be tracked by it


class KeyPictures:
    """Pictures by their time and camera.

    Args:
        cameras: The camera of each picture.
        tau: The time of each, in key spacings.
        keys: Number of key times.
    """

    def __init__(self, cameras: Sequence[str], tau: Float[Tensor, " F"], keys: int) -> None:
        self._cameras: Sequence[str] = cameras
        self._tau, self._keys = tau.cpu(), keys  # pictures are drawn there
        self._all = self.by_camera(torch.arange(len(tau)))

    def around(self, key: int, direction: int) -> Int[Tensor, " f"]:
        """Pictures between a key's neighbours; `direction`, in which keys are visited: 1, or -1 back in time."""
        return self._within_reach(key, 1.0, direction)

    def tracked(self, key: int, direction: int) -> Int[Tensor, " f"]:
        """Of each camera the pictures up to a key on which it has a say; without any, the one right after it.

        Where a key counts for little, Adam, which knows no scale, would move it far for what the key before got wrong.
        """
        away, chosen = (self._tau - key) * direction, []
        for members in self._all:
            at = away[members]
            up_to = members[(at > LEAST_SAY - 1) & (at < AT_KEY)]
            if not len(up_to):
                after = members[(at >= AT_KEY) & (at <= 1 - LEAST_SAY)]
                up_to = after[away[after].argsort()[:1]]
            chosen.append(up_to)
        pictures = torch.cat(chosen).sort().values
        return pictures if len(pictures) else self._within_reach(key, AT_KEY, direction)

    def by_camera(self, pictures: Int[Tensor, " f"]) -> list[Int[Tensor, " _"]]:
        """The same pictures, those of each camera together."""
        cameras: dict[str, list[int]] = {}
        numbers: list[int] = pictures.tolist()
        for picture in numbers:
            cameras.setdefault(self._cameras[picture], []).append(picture)
        return [torch.tensor(cameras[name]) for name in sorted(cameras)]

    def _within_reach(self, key: int, ahead: float, direction: int) -> Int[Tensor, " f"]:
        away = (self._tau - key) * direction
        for reach in (1.0, 2.0, float(self._keys)):  # a dropped frame may leave a key without pictures
            chosen = ((away > -reach) & (away < max(ahead, reach - 1.0 + AT_KEY))).nonzero()[:, 0]
            if len(chosen):
                return chosen
        raise ReconstructError("pictures-none", f"no picture near key time {key}")
