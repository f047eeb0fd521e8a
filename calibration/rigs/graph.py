"""Which fixed cameras are tied together, by what, and which hang loose: the camera graph."""

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from devrf.calibration.bundle.problem import Problem
from devrf.capture.camera import Camera

OPPOSED_DEG = 120.0  # between viewing directions: a board shows its front to one of the two only


@dataclass(frozen=True)
class Link:
    """What two cameras share.

    Attributes:
        a, b: Names.
        corners: Board corners that both saw at one instant.
        points: Points of the sweep that both see.
    """

    a: str
    b: str
    corners: int
    points: int

    @property
    def shared(self) -> int:
        """Both together."""
        return self.corners + self.points


def camera_graph(problem: Problem, index: dict[str, int]) -> tuple[Link, ...]:
    """Links between every two fixed cameras of a problem; bodies that can turn are boards.

    Args:
        problem: With boards, points of the sweep, or both.
        index: Name -> camera of the problem.
    """
    corner = np.unique(
        np.column_stack([problem.obs_body, problem.obs_local.round(9)]), axis=0, return_inverse=True
    )[1].reshape(-1)
    is_board = problem.freedom[problem.obs_body] == 6
    seen = {n: problem.obs_camera == c for n, c in index.items()}
    return tuple(
        Link(
            a,
            b,
            len(np.intersect1d(corner[seen[a] & is_board], corner[seen[b] & is_board])),
            len(np.intersect1d(corner[seen[a] & ~is_board], corner[seen[b] & ~is_board])),
        )
        for a, b in combinations(index, 2)
    )


def degree(name: str, links: tuple[Link, ...], least: float) -> int:
    """Other cameras that share at least so much with one."""
    return sum(link.shared >= least for link in links if name in (link.a, link.b))


def is_opposed(a: Camera, b: Camera) -> bool:
    """Whether two cameras look at each other rather than the same way."""
    cosine = float(a.cam_from_world[2, :3] @ b.cam_from_world[2, :3])
    return bool(cosine < np.cos(np.radians(OPPOSED_DEG)))
