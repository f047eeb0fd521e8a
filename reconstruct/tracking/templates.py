"""How points look: real pictures, each warped from where a camera first showed a point to where it should be now."""

import numpy as np
from scipy.ndimage import minimum_filter

from devrf.reconstruct.tracking.film import Film, Picture, blurred, fetched
from devrf.reconstruct.tracking.sight import Sight

EVEN_PX = 1.5  # standard deviation by which the warp is made smooth
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

    def __init__(self, film: Film, points: int) -> None:
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

    def draw(self, sight: Sight, rgb: np.ndarray, cut: tuple[slice, slice]) -> Picture:
        """A piece of the picture that the film should show: points by their templates, or colours, before what stands.

        Args:
            sight: Of the points.
            rgb: Their colours, of which those count that have no template.
            cut: Rows and columns of the piece.
        """
        picture, ids = self.film.plate[cut].copy(), sight.ids[cut]
        corner = np.array([cut[1].start, cut[0].start])
        y, x = np.nonzero(ids >= 0)
        point = ids[y, x]
        source = self.picture[point]
        picture[y[source == NONE], x[source == NONE]] = rgb[point[source == NONE]]
        for n in np.unique(source[source != NONE]):
            mine = source == n
            row, column, who = y[mine], x[mine], point[mine]
            drawn = np.zeros(ids.shape, np.float32)
            drawn[row, column] = 1
            way = np.zeros((*ids.shape, 2), np.float32)
            way[row, column] = self.at[who] - sight.at[who]
            way = blurred(way, EVEN_PX)[row, column]
            way /= np.maximum(blurred(drawn, EVEN_PX)[row, column], 1e-6)[:, None]
            at = (np.stack([column, row], 1) + corner + way).astype(np.float32)
            picture[row, column] = fetched(self.film.picture(int(n)), at)
        return picture
