"""Rays of posed pictures: which pixel, from where, in which direction, at which time, of which colour.

Pictures stay bytes. Each distinct calibration has one table of viewing directions in its camera's frame (lens
distortion undone once), which a picture's rotation turns into the world. Rays have unit directions; `t` along
them is a distance. Every picture brings its own size, intrinsics, principal point, lens and time.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from devrf.capture.camera import Camera
from devrf.capture.photos.resize import shrink
from devrf.capture.scene import Background, PosedFrame, load_image, read_opacity
from devrf.capture.system.progress import Progress, no_progress

REMEMBERED_LENSES, REMEMBERED_PIXELS = 2, 1 << 20  # a picture and a smaller one of it; 12 MB each

_directions: dict[tuple[object, ...], np.ndarray] = {}  # the newest last


class Rays(NamedTuple):
    """Rays to look along.

    Attributes:
        o: Origins, in the box frame.
        d: Unit directions.
        near: Distance before which they do not begin.
        jitter: Of their first step, in steps; with surroundings of two, in the box and beside it.
        frame: Picture of each ray, where what moves is elsewhere in each.
    """

    o: Float[Tensor, "R 3"]
    d: Float[Tensor, "R 3"]
    near: float
    jitter: Float[Tensor, " R"] | Float[Tensor, "2 R"]
    frame: Int[Tensor, " R"] | None = None

    @staticmethod
    def middle(
        o: Float[Tensor, "R 3"], d: Float[Tensor, "R 3"], near: float, frame: Int[Tensor, " R"] | None = None
    ) -> "Rays":
        """Rays whose steps begin in their middle, as in pictures."""
        return Rays(o, d, near, torch.full_like(o[:, 0], 0.5), frame)


@dataclass(frozen=True)
class RayBatch:
    """Rays that were drawn.

    Attributes:
        rays_o: Origins.
        rays_d: Unit directions.
        rgb: True colours in [0, 1].
        opacity: True opacities in [0, 1], where the pictures carry alpha; else None.
        time: Of each ray's picture in [0, 1]; 0 for pictures without a time.
        frame: Number of each ray's picture in its set.
        pixel: Row times width plus column.
    """

    rays_o: Float[Tensor, "n 3"]
    rays_d: Float[Tensor, "n 3"]
    rgb: Float[Tensor, "n 3"]
    opacity: Float[Tensor, " n"] | None
    time: Float[Tensor, " n"]
    frame: Int[Tensor, " n"]
    pixel: Int[Tensor, " n"]

    def only(self, kept: Bool[Tensor, " n"] | slice) -> "RayBatch":
        """Those of the rays that are marked, or some that follow one another."""
        opacity = None if self.opacity is None else self.opacity[kept]
        parts = (self.rays_o, self.rays_d, self.rgb, self.time, self.frame, self.pixel)
        rays_o, rays_d, rgb, time, frame, pixel = (part[kept] for part in parts)
        return RayBatch(rays_o, rays_d, rgb, opacity, time, frame, pixel)

    def joined(self, other: "RayBatch") -> "RayBatch":
        """These rays and those of another set, whose pictures are numbered by themselves; without opacities."""
        names = ("rays_o", "rays_d", "rgb", "time", "frame", "pixel")
        parts = {name: torch.cat([getattr(self, name), getattr(other, name)]) for name in names}
        return RayBatch(opacity=None, **parts)


class RaySet:
    """All rays of a list of pictures, on one device.

    Attributes:
        frames: The pictures' entries in the scene.
        cameras: Their cameras at training size.
        first: Number of each picture's first pixel among all pixels, and the end of the last [F + 1].
    """

    def __init__(
        self,
        frames: tuple[PosedFrame, ...],
        image_scale: float,
        background: Background,
        device: str = "cpu",
        progress: Progress = no_progress,
    ) -> None:
        cameras = [f.camera.scaled(image_scale) for f in frames]  # rounds sizes as load_image does
        mattes: list[UInt8[np.ndarray, " _"]] = []

        def pictures() -> Iterator[UInt8[np.ndarray, "_ _ 3"]]:
            for n, frame in enumerate(frames):
                picture = load_image(frame, image_scale, background)
                matte = None if background == "shell" else load_matte(frame, picture.shape[:2], background)
                if matte is not None:
                    mattes.append(matte.reshape(-1))
                yield picture
                progress((n + 1) / len(frames), f"reading picture {n + 1} of {len(frames)}")

        self._fill(frames, cameras, pictures(), device)
        if mattes and len(mattes) == len(frames):
            self.opacity = torch.from_numpy(np.concatenate(mattes)).to(device)

    @classmethod
    def of_pictures(
        cls,
        frames: tuple[PosedFrame, ...],
        image_scale: float,
        pictures: Iterable[UInt8[np.ndarray, "_ _ 3"]],
        device: str = "cpu",
    ) -> "RaySet":
        """Rays of frames' cameras through other pictures than theirs, which have the size of training."""
        rays = cls.__new__(cls)
        rays._fill(frames, [f.camera.scaled(image_scale) for f in frames], pictures, device)
        return rays

    def _fill(
        self,
        frames: tuple[PosedFrame, ...],
        cameras: list[Camera],
        pictures: Iterable[np.ndarray],
        device: str,
    ) -> None:
        self.opacity: Tensor | None = None
        self.kept: Tensor | None = None
        self.frames, self.cameras, self.device = frames, cameras, torch.device(device)
        first = np.concatenate([[0], np.cumsum([c.width * c.height for c in cameras], dtype=np.int64)])
        self.first = torch.tensor(first, dtype=torch.int64, device=device)
        flat = np.empty((int(first[-1]), 3), np.uint8)
        for n, picture in enumerate(pictures):  # one by one: a list of them would be as large again
            flat[first[n] : first[n + 1]] = picture.reshape(-1, 3)
        self.pixels = torch.from_numpy(flat).to(device)
        tables: dict[tuple[object, ...], int] = {}
        directions, table_of, size = [], [], 0
        for camera in cameras:
            if camera.lens not in tables:
                tables[camera.lens] = size
                directions.append(local_directions(camera))
                size += len(directions[-1])
            table_of.append(tables[camera.lens])
        self.directions = torch.from_numpy(np.concatenate(directions or [np.zeros((0, 3), np.float32)])).to(
            device
        )
        self.table_of = torch.tensor(table_of, dtype=torch.int64, device=device)
        poses = np.stack([c.world_from_cam for c in cameras]) if cameras else np.zeros((0, 4, 4))
        self.rotations = torch.tensor(poses[:, :3, :3], dtype=torch.float32, device=device)
        self.centres = torch.tensor(poses[:, :3, 3], dtype=torch.float32, device=device)
        times = [f.time or 0.0 for f in frames] or [0.0] * len(cameras)
        self.times = torch.tensor(times, dtype=torch.float32, device=device)

    def __len__(self) -> int:
        """Number of pictures."""
        return len(self.cameras)

    def draw(self, n: int, generator: torch.Generator, frames: Int[Tensor, " f"] | None = None) -> RayBatch:
        """Draw `n` rays, each kept pixel of all pictures (or any of `frames`, each picture alike) with equal chance.

        `frames` are best on the CPU, as the generator is.
        """
        if frames is None:
            among = int(self.first[-1]) if self.kept is None else len(self.kept)
            at = torch.randint(among, (n,), generator=generator).to(self.device)
            if self.kept is not None:
                at = self.kept[at].long()
            frame = torch.searchsorted(self.first, at, right=True) - 1
            return self.at(frame, at - self.first[frame])
        pick = torch.randint(len(frames), (n,), generator=generator)
        share = torch.rand(n, generator=generator, dtype=torch.float64)
        sent = torch.stack([frames.cpu()[pick].double(), share]).to(
            self.device
        )  # at once: a GPU waits for each
        frame = sent[0].long()
        return self.at(frame, (sent[1] * (self.first[frame + 1] - self.first[frame])).long())

    def picture(self, n: int) -> UInt8[np.ndarray, "h w 3"]:
        """A picture of the set as it is trained on."""
        camera, (begin, end) = self.cameras[n], self.first[n : n + 2].tolist()
        return self.pixels[begin:end].cpu().numpy().reshape(camera.height, camera.width, 3)

    def keep_only(self, pixels: Bool[Tensor, " pixels"]) -> None:
        """Draw only these of all pixels from now on, where no pictures are named."""
        if bool(pixels.any()):
            self.kept = pixels.nonzero()[:, 0].int()

    def in_order(self, at_once: int) -> Iterator[RayBatch]:
        """All rays, picture by picture and row by row, some at once."""
        for at in torch.arange(int(self.first[-1]), device=self.device).split(at_once):
            frame = torch.searchsorted(self.first, at, right=True) - 1
            yield self.at(frame, at - self.first[frame])

    def at(self, frame: Int[Tensor, " n"], pixel: Int[Tensor, " n"]) -> RayBatch:
        """The rays through given pixels (row times width plus column) of given pictures."""
        local = self.directions[self.table_of[frame] + pixel]
        rays_d = torch.einsum("nij,nj->ni", self.rotations[frame], local)
        at = self.first[frame] + pixel
        rgb = self.pixels[at].float() / 255
        opacity = None if self.opacity is None else self.opacity[at].float() / 255
        return RayBatch(self.centres[frame], rays_d, rgb, opacity, self.times[frame], frame, pixel)


def load_matte(
    frame: PosedFrame, size: tuple[int, int], background: Background
) -> UInt8[np.ndarray, "h w"] | None:
    """The picture's alpha at (height, width); None where it has none."""
    opacity = read_opacity(frame, background)
    return None if opacity is None else shrink(opacity, size[1], size[0])


def camera_rays(camera: Camera, device: str = "cpu") -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Origins and unit directions of all pixels of a camera, row by row."""
    pose = camera.world_from_cam.astype(np.float32)
    rays_d = _remembered_directions(camera) @ pose[:3, :3].T
    rays_o = np.broadcast_to(pose[:3, 3], rays_d.shape)
    return torch.from_numpy(rays_o.copy()).to(device), torch.from_numpy(rays_d).to(device)


def pixel_directions(camera: Camera) -> Float[np.ndarray, "height width 3"]:
    """Unit directions of all pixels of a camera in the world."""
    directions = _remembered_directions(camera) @ camera.world_from_cam[:3, :3].T
    return directions.reshape(camera.height, camera.width, 3)


def _remembered_directions(camera: Camera) -> Float[np.ndarray, "n 3"]:
    """`local_directions`; for the lenses of a film or of a view that moves they are found once."""
    if camera.width * camera.height > REMEMBERED_PIXELS:
        return local_directions(camera)
    found = _directions.get(camera.lens)
    if found is None:
        found = local_directions(camera)
        while len(_directions) >= REMEMBERED_LENSES:
            _directions.pop(next(iter(tuple(_directions))), None)
        _directions[camera.lens] = found
    return found


def local_directions(camera: Camera) -> Float[np.ndarray, "n 3"]:
    """Unit viewing directions of all pixels in the camera's own frame, row by row."""
    u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    still = replace(camera, cam_from_world=np.eye(3, 4))
    return still.directions(np.stack([u, v], axis=-1).reshape(-1, 2)).astype(np.float32)
