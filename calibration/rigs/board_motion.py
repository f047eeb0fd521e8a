"""How a board moves around each instant, from its poses at the neighbouring instants.

A parabola is fitted to the place of the board's centre and to its turn over a window of instants; it carries
the board of an instant to the time of each view, and says how fast its corners move then.
"""

import cv2
import numpy as np
from jaxtyping import Float, Int

from devrf.calibration.bundle.problem import ViewTiming

WINDOW_PERIODS = 1.5  # each side: at 6 frames/s the neighbours, of fast cameras more: see the next line
MIN_WINDOW_S = 0.1  # a hand moves smoothly over this; one instant's noise over 33 ms would be a wild speed
MAX_GAP_S = 0.5  # a longer pause between instants says nothing about the motion
DELAY_STD_S = 0.1  # of a camera's clock, before the board is looked at: webcams are a frame late


def still(view: Int[np.ndarray, " observations"], cameras: int, views: int) -> ViewTiming:
    """The timing of bodies that do not move."""
    return ViewTiming(
        view=view,
        carry=np.tile(np.eye(3, 4), (views, 1, 1)),
        carried_s=np.zeros(views),
        spin=np.zeros((views, 3)),
        velocity=np.zeros((views, 3)),
        delay_s=np.zeros(cameras),
        delay_std_s=DELAY_STD_S,
        free_delay=np.zeros(cameras, dtype=bool),
        lag_s=np.zeros(views),
        lag_std_s=0.0,
    )


def carried(
    boards: Float[np.ndarray, "instants 3 4"],
    middle: Float[np.ndarray, "3"],
    instant_s: Float[np.ndarray, " instants"],
    period_s: float,
    instant: Int[np.ndarray, " views"],
    offset_s: Float[np.ndarray, " views"],
) -> tuple[Float[np.ndarray, "views 3 4"], Float[np.ndarray, "views 3"], Float[np.ndarray, "views 3"]]:
    """Where each view's board has moved to, its spin and its velocity (`ViewTiming.carry`, `spin`, `velocity`).

    Args:
        boards: world_from_board at the instants.
        middle: Of the board, in its own frame.
        instant_s: Times of the instants, rising; period_s: between pictures of a camera.
        instant: Of each view; offset_s: its time after the instant's.
    """
    views = len(instant)
    carry = np.tile(np.eye(3, 4), (views, 1, 1))
    spin, velocity = np.zeros((views, 3)), np.zeros((views, 3))
    centres = boards[:, :, :3] @ middle + boards[:, :, 3]
    window = max(WINDOW_PERIODS * period_s, MIN_WINDOW_S)
    for i in np.unique(instant):
        near = np.flatnonzero(np.abs(instant_s - instant_s[i]) <= min(window, MAX_GAP_S))
        if len(near) < 2:
            continue
        t = instant_s[near] - instant_s[i]
        turns = np.array([cv2.Rodrigues(boards[j, :, :3] @ boards[i, :, :3].T)[0].reshape(3) for j in near])
        # the parabola passes through the instant itself
        powers = np.stack([t, t**2], axis=1)[:, : len(near) - 1]
        way = np.linalg.lstsq(
            powers, np.concatenate([turns, centres[near] - centres[i]], axis=1), rcond=None
        )[0]
        way = np.vstack([way, np.zeros((2 - len(way), 6))])
        for v in np.flatnonzero(instant == i):
            s = offset_s[v]
            turn, shift = np.split(way[0] * s + way[1] * s**2, 2)
            rate, speed = np.split(way[0] + 2 * way[1] * s, 2)
            R = cv2.Rodrigues(turn)[0]
            carry[v] = np.column_stack([R, centres[i] + shift - R @ centres[i]])
            spin[v], velocity[v] = rate, speed - np.cross(rate, centres[i] + shift)
    return carry, spin, velocity
