"""Persons of 1.2 m, each of rigid limbs: they walk, gesture, kick, hide an arm, put a thing down, stand side by side.

Each stands on the platform of the room of `scenes` and faces the fixed cameras or walks past them. `motion_scale`
multiplies every way and every angle; the times below are seconds since the motion begins, at a motion_speed of 1.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from devrf.lab.simulate.scenes import materials
from devrf.lab.simulate.scenes.bodies import (
    RED,
    SAND,
    as_object,
    fine_ball,
    fine_box,
    limb,
    table,
)
from devrf.lab.simulate.scenes.catalogue import PLATFORM_M, PRINT, Mesh, MovingObject, Paint
from devrf.lab.simulate.scenes.session_options import SessionOptions
from devrf.lab.simulate.scenes.shapes import Number, Part, Pose, ease, quads, rigid, shift, skin, turn

SKIN, HEAD = Paint((214, 160, 130), surface=materials.skin), Paint((214, 160, 130), surface=materials.head)
SHIRT, JERSEY = Paint((58, 108, 84), surface=materials.plaid), Paint((150, 48, 42), surface=materials.plaid)
TROUSERS = Paint((66, 84, 120), surface=materials.twill)
SHOE = Paint((95, 70, 60), surface=materials.painted)
SKULL = np.array([0.95, 0.85, 1.12])  # half axes of a head, of its radius
STEPS_HZ = 1.2  # of the walking figure, both feet once
STRIDE_DEG, LIFT_DEG = 36.0, 55.0  # thighs swing, knees bend: feet reach 4 m/s
WALK_M_S = 0.22
ARM_M = 0.2  # from shoulder to elbow, and from there to the hand
CUBE_M = 0.12

Angle = Callable[[float], float]
"""Degrees at a time."""


def figure(rng: np.random.Generator, options: SessionOptions) -> MovingObject:
    """A person of 1.2 m who walks across the platform and turns, a hand on the thigh at rest."""
    scale = options.motion_scale

    def swing(time: float, phase: Number) -> float:
        grown = ease(time, 0.0, 0.3)
        return scale * grown * float(np.sin(2 * np.pi * (STEPS_HZ * max(time, 0.0) + phase)))

    def hip(time: float) -> Pose:
        forward = scale * WALK_M_S * max(time, 0.0) * ease(time, 0.0, 0.3)
        bob = 0.015 * abs(swing(time, 0.25))
        pose = shift(0.02, -0.26 + forward, PLATFORM_M + 0.62 + bob)
        return pose @ turn("z", 90 + 8 * swing(time, 0.0) + 12 * scale * ease(time, 1.0, 2.4))

    def chest(time: float) -> Pose:
        return (
            hip(time)
            @ shift(0, 0, 0.15)
            @ turn("z", -16 * swing(time, 0.0))
            @ turn("y", 5 * swing(time, 0.3))
        )

    def thigh(side: int) -> Callable[[float], Pose]:
        phase = 0.0 if side > 0 else 0.5
        return lambda t: hip(t) @ shift(0, 0.075 * side, -0.01) @ turn("y", -STRIDE_DEG * swing(t, phase))

    def shin(side: int) -> Callable[[float], Pose]:
        phase, upper = (0.25 if side > 0 else 0.75), thigh(side)

        def pose(time: float) -> Pose:
            return upper(time) @ shift(0, 0, -0.29) @ turn("y", LIFT_DEG * max(swing(time, phase), 0.0))

        return pose

    def upper_arm(side: int) -> Callable[[float], Pose]:
        """Arms swing against the legs; the left hand rests on its thigh and leaves it with the first step."""
        phase = 0.5 if side > 0 else 0.0
        out_deg = 11.0 if side > 0 else 20.0

        def pose(time: float) -> Pose:
            lifted = out_deg + (14 * scale * ease(time, 0.1, 0.6) if side > 0 else 0.0)
            return (
                chest(time)
                @ shift(0, 0.135 * side, 0.21)
                @ turn("x", lifted * side)
                @ turn("y", -32 * swing(time, phase))
            )

        return pose

    def forearm(side: int) -> Callable[[float], Pose]:
        upper = upper_arm(side)
        bend_deg = 14.0 if side > 0 else 24.0

        def pose(time: float) -> Pose:
            bent_deg = bend_deg + 30 * scale * ease(time, 0.1, 0.6)
            return upper(time) @ shift(0, 0, -0.2) @ turn("x", -17.0 * side) @ turn("y", -bent_deg)

        return pose

    joints = Joints(hip, chest, lambda t: chest(t) @ shift(0, 0, 0.32), thigh, shin, upper_arm, forearm)
    return as_object(person(rng, joints), [])


def gesturing(rng: np.random.Generator, options: SessionOptions) -> MovingObject:
    """A person of 1.2 m who stands and talks with the hands: arms rise and come back, the head turns."""
    scale = options.motion_scale

    def wave(time: float, hz: float, phase: float = 0.0) -> float:
        """From 0 to 1 and back, at a rate."""
        return scale * (0.5 - 0.5 * float(np.cos(2 * np.pi * hz * max(time - phase, 0.0))))

    def hip(time: float) -> Pose:
        return shift(0.02, 0.0, PLATFORM_M + 0.62) @ turn("z", 90 + 3 * wave(time, 0.5))

    def chest(time: float) -> Pose:
        return hip(time) @ shift(0, 0, 0.15) @ turn("y", 4 * wave(time, 0.6)) @ turn("z", 6 * wave(time, 0.5))

    def head(time: float) -> Pose:
        return chest(time) @ shift(0, 0, 0.32) @ turn("z", 30 * (wave(time, 0.7) - wave(time, 0.5, 0.6)))

    def thigh(side: int) -> Callable[[float], Pose]:
        return lambda t: hip(t) @ shift(0, 0.075 * side, -0.01) @ turn("z", -3 * wave(t, 0.5))

    def shin(side: int) -> Callable[[float], Pose]:
        upper = thigh(side)
        return lambda t: upper(t) @ shift(0, 0, -0.29)

    def upper_arm(side: int) -> Callable[[float], Pose]:
        hz, phase = (0.8, 0.0) if side > 0 else (0.6, 0.15)

        def pose(time: float) -> Pose:
            risen = wave(time, hz, phase)
            place = chest(time) @ shift(0, 0.135 * side, 0.21) @ turn("x", (10 + 30 * risen) * side)
            return place @ turn("y", -50 * risen)

        return pose

    def forearm(side: int) -> Callable[[float], Pose]:
        upper = upper_arm(side)
        hz, phase = (1.1, 0.1) if side > 0 else (0.9, 0.2)

        def pose(time: float) -> Pose:
            return upper(time) @ shift(0, 0, -0.2) @ turn("y", -15 - 80 * wave(time, hz, phase))

        return pose

    return as_object(person(rng, Joints(hip, chest, head, thigh, shin, upper_arm, forearm)), [])


@dataclass(frozen=True)
class Angles:
    """How the limbs of someone who stands are bent, in degrees.

    Attributes:
        chest: Turn about the vertical.
        head: The same, against the chest.
        kick: By how much the right thigh is raised, and by how much its knee is bent.
        out, forward: Of the upper arms: away from the trunk and ahead, of the left (1) and the right (-1) one.
        bend, twist: Of the forearms: at the elbow, and about the upper arm.
    """

    chest: Angle = lambda t: 0.0
    head: Angle = lambda t: 0.0
    kick: tuple[Angle, Angle] = (lambda t: 0.0, lambda t: 0.0)
    out: Callable[[int, float], float] = lambda side, t: 12.0
    forward: Callable[[int, float], float] = lambda side, t: 0.0
    bend: Callable[[int, float], float] = lambda side, t: 15.0
    twist: Callable[[int, float], float] = lambda side, t: 0.0


def standing(foot: Pose, angles: Angles) -> "Joints":
    """The joints of someone who stands at a pose whose x axis points ahead."""

    def hip(time: float) -> Pose:
        return foot @ shift(0, 0, 0.62)

    def chest(time: float) -> Pose:
        return hip(time) @ shift(0, 0, 0.15) @ turn("z", angles.chest(time))

    def neck(time: float) -> Pose:
        return chest(time) @ shift(0, 0, 0.32) @ turn("z", angles.head(time))

    def thigh(side: int) -> Callable[[float], Pose]:
        raised, _ = angles.kick
        return lambda t: hip(t) @ shift(0, 0.075 * side, -0.01) @ turn("y", -raised(t) if side < 0 else 0.0)

    def shin(side: int) -> Callable[[float], Pose]:
        upper, (_, bent) = thigh(side), angles.kick
        return lambda t: upper(t) @ shift(0, 0, -0.29) @ turn("y", bent(t) if side < 0 else 0.0)

    def upper_arm(side: int) -> Callable[[float], Pose]:
        return lambda t: (
            chest(t)
            @ shift(0, 0.135 * side, 0.21)
            @ turn("x", angles.out(side, t) * side)
            @ turn("y", -angles.forward(side, t))
        )

    def forearm(side: int) -> Callable[[float], Pose]:
        upper = upper_arm(side)
        return lambda t: (
            upper(t)
            @ shift(0, 0, -ARM_M)
            @ turn("z", angles.twist(side, t) * side)
            @ turn("y", -angles.bend(side, t))
        )

    return Joints(hip, chest, neck, thigh, shin, upper_arm, forearm)


def kicking(rng: np.random.Generator, options: SessionOptions) -> MovingObject:
    """A person who kicks in a quarter of a second and takes the leg back slowly."""
    scale = options.motion_scale

    def raised(time: float) -> float:
        return scale * 75.0 * (ease(time, 0.5, 0.75) - ease(time, 0.9, 2.2))

    def bent(time: float) -> float:
        return scale * 60.0 * (ease(time, 0.2, 0.5) - ease(time, 0.55, 0.75))

    angles = Angles(
        chest=lambda t: 0.15 * raised(t),
        kick=(raised, bent),
        out=lambda side, t: 15.0 + 0.4 * raised(t),
        forward=lambda side, t: -0.3 * side * raised(t),
    )
    return as_object(person(rng, standing(_foot(0.0), angles)), [])


def hiding(rng: np.random.Generator, options: SessionOptions) -> MovingObject:
    """A person whose right forearm is behind the back for half a second and comes back turned about itself."""
    scale = options.motion_scale

    def behind(time: float) -> float:
        return scale * (ease(time, 0.4, 0.9) - ease(time, 1.4, 1.9))

    def after(time: float) -> float:
        return scale * ease(time, 0.9, 1.4)

    def of_right(side: int, value: float) -> float:
        return value if side < 0 else 0.0

    angles = Angles(
        head=lambda t: 20.0 * after(t),
        out=lambda side, t: 14.0 - of_right(side, 10.0 * behind(t)),
        forward=lambda side, t: of_right(side, 25.0 - 75.0 * behind(t)),
        bend=lambda side, t: 20.0 + of_right(side, 45.0 + 35.0 * behind(t)),
        twist=lambda side, t: of_right(side, -70.0 * behind(t) + 120.0 * after(t)),
    )
    return as_object(person(rng, standing(_foot(0.0), angles)), [])


def pair(rng: np.random.Generator, options: SessionOptions) -> MovingObject:
    """Two people side by side: one points and turns, the other waves."""
    scale = options.motion_scale

    def wave(time: float, hz: float) -> float:
        return scale * (0.5 - 0.5 * float(np.cos(2 * np.pi * hz * max(time, 0.0))))

    one = Angles(
        chest=lambda t: 25.0 * wave(t, 0.4),
        head=lambda t: -30.0 * wave(t, 0.5),
        forward=lambda side, t: (70.0 if side > 0 else 15.0) * wave(t, 0.6),
        bend=lambda side, t: 15.0 + 30.0 * wave(t, 0.8),
    )
    other = Angles(
        chest=lambda t: -12.0 * wave(t, 0.5),
        out=lambda side, t: 12.0 + (95.0 * wave(t, 0.4) if side > 0 else 0.0),
        bend=lambda side, t: 20.0 + 60.0 * wave(t, 1.1),
    )
    parts = person(rng, standing(_foot(-0.3), one))
    return as_object([*parts, *person(rng, standing(_foot(0.3), other), JERSEY)], [])


def placing(rng: np.random.Generator, options: SessionOptions) -> MovingObject:
    """A person who lifts a cube from a table, turns and puts it down elsewhere; a lamp swings and a cloth waves behind.

    The hand is above the cube at rest, goes down to it, holds it from 0.5 to 1.8 s and leaves it.
    """
    scale = options.motion_scale
    grab_s, put_s = 0.5, 1.8

    def bend(side: int, time: float) -> float:
        """The right elbow is bent at rest, stretched to the cube, bent while it carries, and bent again after."""
        lifted = ease(time, grab_s + 0.1, grab_s + 0.5) - ease(time, put_s - 0.4, put_s - 0.05)
        away = 1.0 - ease(time, 0.05, grab_s) + ease(time, put_s + 0.1, put_s + 0.6)
        return 15.0 if side > 0 else 30.0 + 25.0 * (1 - scale) + scale * (25.0 * away + 30.0 * lifted)

    angles = Angles(
        chest=lambda t: scale * 50.0 * ease(t, grab_s + 0.3, put_s - 0.25),
        head=lambda t: -scale * 15.0 * ease(t, 0.2, 0.6),
        forward=lambda side, t: 45.0 if side < 0 else 5.0,
        bend=bend,
    )
    joints = standing(_foot(0.1, -0.22), angles)
    forearm = joints.forearm(-1)

    def hand(time: float) -> np.ndarray:
        return (forearm(time) @ shift(0, 0, -ARM_M))[:3, 3]

    held = hand(grab_s)

    def cube(time: float) -> Pose:
        x, y, z = held + (hand(float(np.clip(time, grab_s, put_s))) - held if scale else 0.0)
        chest_deg = angles.chest(float(np.clip(time, grab_s, put_s)))
        return shift(x, y, z - CUBE_M / 2 - 0.02) @ turn("z", chest_deg)

    parts = person(rng, joints)
    parts.append(rigid(fine_box(rng, (CUBE_M, CUBE_M, CUBE_M), RED, 0.012), cube))
    top_m = float(held[2]) - CUBE_M - 0.02
    return as_object([*parts, *_scenery(rng, scale)], table(rng, options, (0.3, 0.6), top_m, (0.24, 0.05)))


def _scenery(rng: np.random.Generator, scale: float) -> list[Part]:
    """A lamp that swings on its cord, and a cloth that waves, behind whoever stands there."""

    def cord(time: float) -> Pose:
        swung = scale * ease(time, 0.0, 0.4) * float(np.sin(2 * np.pi * 0.6 * max(time, 0.0)))
        return shift(-0.4, 0.42, 1.75) @ turn("x", 18.0 * swung)

    rows, columns, width_m, height_m = 24, 16, 0.4, 0.75
    down = np.linspace(0, 1, rows)[:, None]
    across = np.linspace(-0.5, 0.5, columns)[None, :]
    uv = np.stack(np.meshgrid(np.linspace(0, 1, columns), np.linspace(0, 1, rows)), -1).reshape(-1, 2)

    def cloth(time: float) -> np.ndarray:
        w = 2 * np.pi * 0.7 * max(time, 0.0)
        wave = 0.1 * scale * ease(time, 0.0, 0.5) * down * np.sin(w - 4.0 * down + 3.0 * across)
        x = -0.42 + wave + 0.02 * np.sin(2 * np.pi * 3 * across)
        y, z = -0.38 + width_m * across + 0 * down, 1.5 - height_m * down + 0 * across
        return np.stack([x + 0 * across, y, z], -1).reshape(-1, 3)

    print_ = skin(rng, 3 * width_m, 3 * height_m, PRINT)
    mesh = Mesh(cloth(0.0), quads(rows, columns)[:, ::-1].copy(), uv, print_, smooth=True, thickness_m=0.002)
    return [
        rigid(limb(rng, SAND, 0.5, 0.012, 0.012), cord),
        rigid(fine_ball(rng, SAND, 0.09), lambda t: cord(t) @ shift(0, 0, -0.55)),
        Part(mesh, cloth),
    ]


def _foot(y: Number, x: Number = 0.02) -> Pose:
    """Where someone stands who faces the fixed cameras."""
    return shift(x, y, PLATFORM_M)


@dataclass(frozen=True)
class Joints:
    """Where the parts of a person are at a time; of limbs, those of the left (1) and of the right side (-1).

    The head's is the neck.
    """

    hip: Callable[[float], Pose]
    chest: Callable[[float], Pose]
    neck: Callable[[float], Pose]
    thigh: Callable[[int], Callable[[float], Pose]]
    shin: Callable[[int], Callable[[float], Pose]]
    upper_arm: Callable[[int], Callable[[float], Pose]]
    forearm: Callable[[int], Callable[[float], Pose]]


def person(rng: np.random.Generator, joints: Joints, shirt: Paint = SHIRT) -> list[Part]:
    """The limbs of a person, in a shirt of these colours."""
    skull = fine_ball(rng, HEAD, 0.085)
    skull = replace(skull, vertices=skull.vertices * SKULL)
    parts = [
        rigid(fine_box(rng, (0.15, 0.24, 0.22), TROUSERS, 0.06), lambda t: joints.hip(t) @ shift(0, 0, 0.03)),
        rigid(fine_box(rng, (0.16, 0.27, 0.3), shirt, 0.07), lambda t: joints.chest(t) @ shift(0, 0, 0.1)),
        rigid(limb(rng, SKIN, 0.09, 0.045, 0.045), joints.neck),
        rigid(skull, lambda t: joints.neck(t) @ shift(0.01, 0, 0.07)),
    ]
    for side in (1, -1):
        shin = joints.shin(side)
        parts += [
            rigid(limb(rng, TROUSERS, 0.29, 0.07, 0.055), joints.thigh(side)),
            rigid(limb(rng, TROUSERS, 0.27, 0.055, 0.04), shin),
            rigid(
                fine_box(rng, (0.19, 0.08, 0.07), SHOE, 0.03),
                lambda t, shin=shin: shin(t) @ shift(0.045, 0, -0.285),
            ),
            rigid(limb(rng, shirt, 0.2, 0.047, 0.04), joints.upper_arm(side)),
            rigid(limb(rng, SKIN, 0.2, 0.038, 0.032), joints.forearm(side)),
        ]
    return parts
