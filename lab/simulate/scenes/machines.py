"""Models of rigid parts: a robot whose parts float apart, a robot arm.

World: z up, front along +x, the origin in the middle, two to three units in size and within 1.35 units of the
origin at all times, so that cameras four units away see all of it. `motion_scale` multiplies every motion.
"""

from functools import partial

import numpy as np

from devrf.lab.simulate.scenes.catalogue import Paint
from devrf.lab.simulate.scenes.shapes import (
    Model,
    Number,
    Part,
    Pose,
    ball,
    cylinder,
    ease,
    rigid,
    rounded_box,
    shift,
    turn,
    turned,
)

RED = Paint((190, 60, 45), 60.0)
YELLOW = Paint((215, 165, 45), 60.0)
BLUE = Paint((60, 105, 180), 60.0)
TEAL = Paint((60, 150, 150), 60.0)
ORANGE = Paint((220, 120, 50), 60.0)
GREY = Paint((140, 145, 150), 55.0)
DARK = Paint((62, 62, 70), 35.0)
LIGHT = Paint((235, 225, 170), 15.0)


def robot(rng: np.random.Generator, motion_scale: float) -> Model:
    """A toy robot whose rigid pieces drift and turn apart."""
    box, disc, facing = partial(rounded_box, rng), partial(cylinder, rng), turn("y", 90)
    head = [
        (box((0.42, 0.52, 0.4), TEAL, 0.09), shift(0, 0, 0)),
        (box((0.04, 0.3, 0.06), DARK, 0.02), shift(0.205, 0, -0.1)),
        (disc(GREY, 0.02, 0.18, 0.32), shift(0, 0, 0)),
        (ball(rng, RED, 0.055), shift(0, 0, 0.33)),
        *((disc(LIGHT, 0.075, 0, 0.03), shift(0.205, 0.12 * s, 0.06) @ facing) for s in (1, -1)),
        *((disc(DARK, 0.035, 0, 0.045), shift(0.205, 0.12 * s, 0.06) @ facing) for s in (1, -1)),
    ]
    knobs = ((RED, -0.12), (YELLOW, 0.0), (TEAL, 0.12))
    trunk = [
        (box((0.42, 0.66, 0.72), BLUE, 0.1), shift(0, 0, 0)),
        (box((0.05, 0.4, 0.3), GREY, 0.02), shift(0.2, 0, 0.08)),
        *((disc(paint, 0.045, 0, 0.03), shift(0.22, y, 0.12) @ facing) for paint, y in knobs),
    ]
    nozzle = ([(0, -0.32), (0.1, -0.32)], [(0.1, -0.32), (0.06, -0.2)], [(0.06, -0.2), (0, -0.2)])
    pack = [
        (box((0.2, 0.46, 0.5), ORANGE, 0.06), shift(0, 0, 0)),
        *((turned(rng, GREY, *nozzle), shift(0, 0.13 * s, 0)) for s in (1, -1)),
    ]
    pieces = [  # drift, the middle of the piece, then its meshes about that
        ((0.05, 0.0, 0.26), (0, 0, 0.68), head),
        ((0.1, 0.0, 0.02), (0, 0, 0.08), trunk),
        ((-0.3, 0.0, 0.1), (-0.34, 0, 0.12), pack),
    ]
    for s in (1, -1):
        shoulder = [
            (ball(rng, GREY, 0.12), shift(0, 0, 0.12)),
            (box((0.19, 0.19, 0.34), ORANGE, 0.06), shift(0, 0, -0.06)),
        ]
        hand = [
            (box((0.16, 0.16, 0.3), TEAL, 0.05), shift(0, 0, 0.06)),
            *((box((0.16, 0.05, 0.16), DARK, 0.02), shift(0, 0.07 * q, -0.15)) for q in (1, -1)),
        ]
        pieces += [
            ((0.0, 0.28 * s, 0.16), (0, 0.47 * s, 0.22), shoulder),
            ((0.12, 0.34 * s, -0.06), (0, 0.48 * s, -0.2), hand),
            ((0.05, 0.14 * s, -0.1), (0, 0.19 * s, -0.55), [(box((0.26, 0.25, 0.46), RED, 0.06), np.eye(4))]),
            (
                (0.12, 0.2 * s, -0.17),
                (0.06, 0.19 * s, -0.9),
                [(box((0.42, 0.27, 0.17), YELLOW, 0.06), np.eye(4))],
            ),
        ]
    parts: list[Part] = []
    for i, (drift, middle, meshes) in enumerate(pieces):
        axis = rng.normal(size=3)
        angle_deg = motion_scale * rng.uniform(32, 60) * (0.5 if i == 1 else 1.0)

        def pose(time: float, drift=drift, middle=middle, axis=axis, angle_deg=angle_deg) -> Pose:
            e = ease(time)
            return shift(*np.array(middle) + motion_scale * e * np.array(drift)) @ turn(axis, e * angle_deg)

        for mesh, local in meshes:
            parts.append(rigid(mesh, lambda time, pose=pose, local=local: pose(time) @ local))
    return tuple(parts)


def arm(rng: np.random.Generator, motion_scale: float) -> Model:
    """A robot arm on a plinth: it swings about its base, reaches out, turns its wrist and closes its gripper."""

    def angles(time: float) -> dict[str, Number]:
        e = motion_scale * ease(time)
        return {
            "base": -35 + 75 * e,
            "shoulder": -14 + 40 * e,
            "elbow": 36 + 50 * e,
            "wrist": 50 - 62 * e,
            "roll": 100 * e,
            "grip": 0.13 - 0.07 * min(e, 1.0),
        }

    def base(time: float) -> Pose:
        return shift(-0.15, 0, -0.72) @ turn("z", angles(time)["base"])

    def upper(time: float) -> Pose:
        return base(time) @ shift(0, 0, 0.16) @ turn("y", angles(time)["shoulder"])

    def fore(time: float) -> Pose:
        return upper(time) @ shift(0, 0, 0.78) @ turn("y", angles(time)["elbow"])

    def hand(time: float) -> Pose:
        a = angles(time)
        return fore(time) @ shift(0, 0, 0.62) @ turn("y", a["wrist"]) @ turn("z", a["roll"])

    box, disc, across = partial(rounded_box, rng), partial(cylinder, rng), turn("x", 90)
    parts = [
        rigid(box((0.9, 0.9, 0.14), GREY, 0.05), shift(-0.15, 0, -1.03)),
        rigid(disc(DARK, 0.36, 0, 0.12, 0.04), shift(-0.15, 0, -0.97)),
    ]
    links = [
        (disc(ORANGE, 0.29, -0.14, 0.0, 0.04), base, shift(0, 0, 0)),
        *((box((0.26, 0.09, 0.36), ORANGE, 0.04), base, shift(0, 0.2 * s, 0.12)) for s in (1, -1)),
        (disc(DARK, 0.14, -0.27, 0.27), upper, across),
        (box((0.23, 0.24, 0.84), YELLOW, 0.08), upper, shift(0, 0, 0.38)),
        (disc(BLUE, 0.15, -0.18, 0.18, 0.03), fore, across),
        (box((0.18, 0.18, 0.62), TEAL, 0.06), fore, shift(0, 0, 0.33)),
        (disc(RED, 0.11, -0.13, 0.13, 0.03), fore, shift(0, 0, 0.62) @ across),
        (disc(GREY, 0.09, 0.03, 0.2), hand, shift(0, 0, 0)),
        (box((0.16, 0.42, 0.09), RED, 0.03), hand, shift(0, 0, 0.22)),
    ]
    parts += [rigid(mesh, lambda time, f=frame, p=local: f(time) @ p) for mesh, frame, local in links]
    for s in (1, -1):
        finger = box((0.11, 0.06, 0.28), DARK if s > 0 else BLUE, 0.02)

        def finger_pose(time: float, s: int = s) -> Pose:
            return hand(time) @ shift(0, s * angles(time)["grip"], 0.38)

        parts.append(rigid(finger, finger_pose))
    return tuple(parts)
