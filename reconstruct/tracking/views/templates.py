"""How points look: real pictures, each warped from where a camera first showed a point to where it should be now."""

import numpy as np
from scipy.ndimage import minimum_filter

from devrf.reconstruct.tracking.views.film import CameraFilm, Picture, blurred, fetched
from devrf.reconstruct.tracking.views.sight import Sight

EVEN_PX, REACH = 1.5, 8  # standard deviation by which the warp is made smooth; pixels beyond its kernel
FEWEST = 15  # points that are worth another picture
LIKE_PX = 1.2  # blur of pictures that are held against what stands
NONE = -1


class Templates:
    """For each point the first picture of one film that shows it, and where.

    Attributes:
        picture: Number in the film; NONE: no picture has shown it yet [p].
        at: Pixel there [p, 2].
        behind: What stands, as pictures are compared [h, w, 3].
    """

    def __init__(self, film: CameraFilm, points: int) -> None:
        self.film = film
        self.behind = blurred(film.high_pass(film.plate), LIKE_PX)
        self.picture = np.full(points, NONE)
        self.at = np.zeros((points, 2), np.float32)

    def learn(self, n: int, sight: Sight, fewest: int = FEWEST) -> None:
        """Take picture `n` for points that are seen for the first time, inside the outline."""
        inside = minimum_filter(sight.ids >= 0, size=3)
        new = sight.seen & (self.picture == NONE) & inside[sight.pixel[:, 1], sight.pixel[:, 0]]
        if new.sum() >= fewest:
            self.picture[new] = n
            self.at[new] = sight.at[new]

    def known(self, sight: Sight) -> np.ndarray:
        """Numbers of the points that are seen now and have a template."""
        return np.flatnonzero(sight.seen & (self.picture != NONE))

    def draw(self, sight: Sight, rgb: np.ndarray) -> Picture:
        """The picture that the film should show: points by their templates, or colours, before what stands."""
        picture = self.film.plate.copy()
        y, x = np.nonzero(sight.ids >= 0)
        point = sight.ids[y, x]
        source = self.picture[point]
        picture[y[source == NONE], x[source == NONE]] = rgb[point[source == NONE]]
        for n in np.unique(source[source != NONE]):
            mine = source == n
            row, column, who = y[mine], x[mine], point[mine]
            top, left = max(0, row.min() - REACH), max(0, column.min() - REACH)
            piece = np.s_[top : row.max() + REACH + 1, left : column.max() + REACH + 1]
            here, size = (row - top, column - left), sight.ids[piece].shape
            drawn, way = np.zeros(size, np.float32), np.zeros((*size, 2), np.float32)
            drawn[here], way[here] = 1, self.at[who] - sight.at[who]
            even = blurred(way, EVEN_PX)[here]
            even /= np.maximum(blurred(drawn, EVEN_PX)[here], 1e-6)[:, None]
            at = (np.stack([column, row], 1) + even).astype(np.float32)
            picture[row, column] = fetched(self.film.picture(int(n)), at)
        return picture
