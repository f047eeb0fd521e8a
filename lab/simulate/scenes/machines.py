"""Models of rigid parts: a vehicle, a robot whose parts float apart, a robot arm.

World: z up, front along +x, the origin in the middle, two to three units in size and within 1.35 units of the
origin at all times, so that cameras four units away see all of it. `motion_scale` multiplies every motion.
"""

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
GLASS = Paint((95, 140, 175), 40.0)
LIGHT = Paint((235, 225, 170), 15.0)


def vehicle(rng: np.random.Generator, motion_scale: float) -> Model:
    """A toy dump truck: the bed tilts with its load, wheels turn, the front ones steer."""
    fixed = [
        (rounded_box(rng, (2.05, 0.5, 0.16), DARK), shift(0, 0, -0.36)),
        (rounded_box(rng, (0.62, 0.92, 0.86), RED, 0.1), shift(0.72, 0, 0.13)),
        (rounded_box(rng, (0.05, 0.74, 0.34), GLASS, 0.02), shift(1.02, 0, 0.28)),
        (rounded_box(rng, (0.36, 0.96, 0.3), GLASS, 0.02), shift(0.74, 0, 0.3)),
        (rounded_box(rng, (0.16, 0.98, 0.14), GREY), shift(1.02, 0, -0.33)),
        (rounded_box(rng, (0.05, 0.5, 0.16), DARK, 0.02), shift(1.03, 0, -0.07)),
        (cylinder(rng, GREY, 0.045, 0, 0.75), shift(0.36, 0.38, -0.2)),
    ]
    fixed += [
        (cylinder(rng, LIGHT, 0.08, 0, 0.06), shift(1.0, 0.34 * s, -0.1) @ turn("y", 90)) for s in (1, -1)
    ]
    parts = [rigid(mesh, pose) for mesh, pose in fixed]
    for x in (0.66, -0.62):
        for s in (1, -1):
            parts += _wheel(rng, (x, 0.5 * s, -0.42), s, 26.0 * motion_scale * (x > 0), 150 * motion_scale)

    hinge = shift(-0.92, 0, -0.2)

    def bed(time: float) -> Pose:
        return hinge @ turn("y", -48 * motion_scale * ease(time)) @ shift(0.62, 0, 0)

    walls = [
        ((1.3, 1.0, 0.1), (0, 0, 0)),
        ((0.09, 1.0, 0.46), (0.62, 0, 0.25)),
        ((0.09, 1.0, 0.32), (-0.62, 0, 0.18)),
    ]
    walls += [((1.3, 0.09, 0.42), (0, 0.47 * s, 0.22)) for s in (1, -1)]
    load = [
        (ball(rng, paint, r), place)
        for paint, r, place in (
            (BLUE, 0.24, (0.3, 0.16, 0.27)),
            (TEAL, 0.19, (-0.12, -0.2, 0.22)),
            (ORANGE, 0.17, (-0.3, 0.22, 0.2)),
            (RED, 0.15, (0.3, -0.27, 0.19)),
        )
    ]
    load += [(rounded_box(rng, size, YELLOW), place) for size, place in walls]
    parts += [rigid(mesh, lambda time, place=place: bed(time) @ shift(*place)) for mesh, place in load]

    def piston(time: float, from_bed: bool) -> Pose:
        low, high = np.array([0.05, 0, -0.33]), (bed(time) @ [0.35, 0, 0, 1])[:3]
        lean = np.degrees(np.arctan2(high[0] - low[0], high[2] - low[2]))
        return shift(*(high if from_bed else low)) @ turn("y", lean)

    parts.append(rigid(cylinder(rng, GREY, 0.035, -0.6, 0.0), lambda time: piston(time, True)))
    return tuple(parts)


def _wheel(
    rng: np.random.Generator,
    place: tuple[Number, Number, Number],
    side: int,
    steer_deg: Number,
    roll_deg: Number,
) -> list[Part]:
    """A tyre, a hub and three bolts; `side` is the sign of y that looks outward."""

    def pose(time: float) -> Pose:
        axle = turn("x", -90.0 * side)  # the wheel's z points outward
        return shift(*place) @ turn("z", steer_deg * ease(time)) @ turn("y", roll_deg * ease(time)) @ axle

    tyre = [(0.2, -0.11), (0.28, -0.11), (0.315, -0.07), (0.32, 0), (0.315, 0.07), (0.28, 0.11), (0.2, 0.11)]
    meshes = [
        turned(
            rng,
            DARK,
            [(0, -0.11), (0.2, -0.11)],
            tyre,
            [(0.2, 0.11), (0.19, 0.07)],
            [(0.19, 0.07), (0, 0.07)],
        )
    ]
    meshes.append(cylinder(rng, YELLOW, 0.17, 0.0, 0.11))
    parts = [rigid(mesh, pose) for mesh in meshes]
    for k in range(3):
        bolt = shift(0.1 * np.cos(2.1 * k), 0.1 * np.sin(2.1 * k), 0.11)
        parts.append(rigid(ball(rng, (RED, BLUE, GREY)[k], 0.035), lambda time, bolt=bolt: pose(time) @ bolt))
    return parts


def robot(rng: np.random.Generator, motion_scale: float) -> Model:
    """A toy robot whose rigid pieces drift and turn apart."""
    face_x = turn("y", 90)
    pieces = [  # drift, then the meshes of the piece about its own middle, then that middle
        (
            (0.05, 0.0, 0.26),
            (0, 0, 0.68),
            [
                (rounded_box(rng, (0.42, 0.52, 0.4), TEAL, 0.09), shift(0, 0, 0)),
                (rounded_box(rng, (0.04, 0.3, 0.06), DARK, 0.02), shift(0.205, 0, -0.1)),
                (cylinder(rng, GREY, 0.02, 0.18, 0.32), shift(0, 0, 0)),
                (ball(rng, RED, 0.055), shift(0, 0, 0.33)),
                *(
                    (cylinder(rng, LIGHT, 0.075, 0, 0.03), shift(0.205, 0.12 * s, 0.06) @ face_x)
                    for s in (1, -1)
                ),
                *(
                    (cylinder(rng, DARK, 0.035, 0, 0.045), shift(0.205, 0.12 * s, 0.06) @ face_x)
                    for s in (1, -1)
                ),
            ],
        ),
        (
            (0.1, 0.0, 0.02),
            (0, 0, 0.08),
            [
                (rounded_box(rng, (0.42, 0.66, 0.72), BLUE, 0.1), shift(0, 0, 0)),
                (rounded_box(rng, (0.05, 0.4, 0.3), GREY, 0.02), shift(0.2, 0, 0.08)),
                *(
                    (
                        cylinder(rng, (RED, YELLOW, TEAL)[k], 0.045, 0, 0.03),
                        shift(0.22, 0.12 * (k - 1), 0.12) @ face_x,
                    )
                    for k in range(3)
                ),
            ],
        ),
        (
            (-0.3, 0.0, 0.1),
            (-0.34, 0, 0.12),
            [
                (rounded_box(rng, (0.2, 0.46, 0.5), ORANGE, 0.06), shift(0, 0, 0)),
                *(
                    (
                        turned(
                            rng,
                            GREY,
                            [(0, -0.32), (0.1, -0.32)],
                            [(0.1, -0.32), (0.06, -0.2)],
                            [(0.06, -0.2), (0, -0.2)],
                        ),
                        shift(0, 0.13 * s, 0),
                    )
                    for s in (1, -1)
                ),
            ],
        ),
    ]
    for s in (1, -1):
        pieces += [
            (
                (0.0, 0.28 * s, 0.16),
                (0, 0.47 * s, 0.22),
                [
                    (ball(rng, GREY, 0.12), shift(0, 0, 0.12)),
                    (rounded_box(rng, (0.19, 0.19, 0.34), ORANGE, 0.06), shift(0, 0, -0.06)),
                ],
            ),
            (
                (0.12, 0.34 * s, -0.06),
                (0, 0.48 * s, -0.2),
                [
                    (rounded_box(rng, (0.16, 0.16, 0.3), TEAL, 0.05), shift(0, 0, 0.06)),
                    *(
                        (rounded_box(rng, (0.16, 0.05, 0.16), DARK, 0.02), shift(0, 0.07 * q, -0.15))
                        for q in (1, -1)
                    ),
                ],
            ),
            (
                (0.05, 0.14 * s, -0.1),
                (0, 0.19 * s, -0.55),
                [(rounded_box(rng, (0.26, 0.25, 0.46), RED, 0.06), shift(0, 0, 0))],
            ),
            (
                (0.12, 0.2 * s, -0.17),
                (0.06, 0.19 * s, -0.9),
                [(rounded_box(rng, (0.42, 0.27, 0.17), YELLOW, 0.06), shift(0, 0, 0))],
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

    across = turn("x", 90)
    parts = [
        rigid(rounded_box(rng, (0.9, 0.9, 0.14), GREY, 0.05), shift(-0.15, 0, -1.03)),
        rigid(cylinder(rng, DARK, 0.36, 0, 0.12, 0.04), shift(-0.15, 0, -0.97)),
    ]
    links = [
        (cylinder(rng, ORANGE, 0.29, -0.14, 0.0, 0.04), base, shift(0, 0, 0)),
        *(
            (rounded_box(rng, (0.26, 0.09, 0.36), ORANGE, 0.04), base, shift(0, 0.2 * s, 0.12))
            for s in (1, -1)
        ),
        (cylinder(rng, DARK, 0.14, -0.27, 0.27), upper, across),
        (rounded_box(rng, (0.23, 0.24, 0.84), YELLOW, 0.08), upper, shift(0, 0, 0.38)),
        (cylinder(rng, BLUE, 0.15, -0.18, 0.18, 0.03), fore, across),
        (rounded_box(rng, (0.18, 0.18, 0.62), TEAL, 0.06), fore, shift(0, 0, 0.33)),
        (cylinder(rng, RED, 0.11, -0.13, 0.13, 0.03), fore, shift(0, 0, 0.62) @ across),
        (cylinder(rng, GREY, 0.09, 0.03, 0.2), hand, shift(0, 0, 0)),
        (rounded_box(rng, (0.16, 0.42, 0.09), RED, 0.03), hand, shift(0, 0, 0.22)),
    ]
    parts += [rigid(mesh, lambda time, f=frame, p=local: f(time) @ p) for mesh, frame, local in links]
    for s in (1, -1):
        finger = rounded_box(rng, (0.11, 0.06, 0.28), DARK if s > 0 else BLUE, 0.02)

        def finger_pose(time: float, s: int = s) -> Pose:
            return hand(time) @ shift(0, s * angles(time)["grip"], 0.38)

        parts.append(rigid(finger, finger_pose))
    return tuple(parts)
