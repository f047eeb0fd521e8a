"""Render a forward-facing data set: a model that moves before a wall, cameras side by side.

`simulate_forward` writes the published layout and the exact truth (V views; the last one is for testing only):

    static/images/NNN.png, poses_bounds.npy          the sweep, then the V fixed cameras' pictures, all at rest
    dynamic_<V>views/poses.npy, bds.npy              of all pictures in static/images, after `normalised`
    dynamic_<V>views/view<k>/images/NNN.png          times 0 to 1
    dynamic_<V>views/view<k>/images_flow/NNN_bwd.npz, depth/NNN.npz
    scene.yaml, made_by.json

Colours are those of the photograph, wall included, everywhere; alpha is the matte of the model. The world
has x right, z up and the cameras on the plane y = -4.9, looking along +y.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from devrf.capture.camera import Camera
from devrf.capture.formats import FLIP_YZ
from devrf.capture.system.errors import InputError
from devrf.capture.system.progress import Progress, no_progress
from devrf.capture.view_axes import look_at
from devrf.lab.simulate.protocol.dataset_options import ForwardOptions
from devrf.lab.simulate.protocol.simulate_dataset import Made, check_simulation, lens, made_by, scene_yaml
from devrf.lab.simulate.render.filmed import MomentCache
from devrf.lab.simulate.render.folder import OutputFolder
from devrf.lab.simulate.render.studio import Studio
from devrf.lab.simulate.scenes.catalogue import Paint, picture_on_quad, texture
from devrf.lab.simulate.scenes.models import MODELS
from devrf.lab.simulate.scenes.shapes import Model, Part, rigid, turn
from devrf.lab.simulate.scenes.simulation import Simulation

DISTANCE = 4.9  # of the cameras' plane from the model's middle: all of it is seen from everywhere
WALL_Y = 1.6  # behind everything that moves
WALL_HALF = 6.5  # covers the view of pictures whose sides differ up to twofold
WALL_TEXEL = 0.012
WALL = Paint((150, 160, 170), 38.0)
WOBBLE_DEG = 2.0  # largest turn of a camera of the sweep away from straight ahead
MARGIN = 0.75  # of the nearest depth; LLFF's bd_factor
# Places of the fixed cameras in the region, from -1 to 1: right and up.
TEST_PLACE = (0.1, -0.05)
PLACES = (
    (-0.85, 0.4),
    (0.85, 0.5),
    (0.0, -0.8),
    (-0.6, -0.6),
    (0.6, -0.5),
    (0.0, 0.8),
    (-0.9, -0.1),
    (0.9, 0.0),
)


def simulate_forward(
    out: Path, simulation: Simulation[ForwardOptions], *, progress: Progress = no_progress
) -> Made:
    """Render a forward-facing data set with known truth, or go on with one begun for the same simulation.

    Args:
        out: Folder to write: new, empty, or begun earlier.
        simulation: Of a scene out of `MODELS`, with 1 to 8 cameras; the test camera is one more.
        progress: Told after every picture.
    Raises:
        InputError: Unknown scene, bad numbers, folder that holds something else, or mitsuba not installed.
    """
    check_simulation("devrf-forward", simulation, len(PLACES))
    scene, cameras, seed, size = simulation.scene, simulation.cameras, simulation.seed, simulation.size
    options = simulation.options
    if max(size) > 2 * min(size):
        wrong = f"simulate --size {size[0]}x{size[1]}: the wall covers at most 2:1"
        raise InputError("option-out-of-range", f"{wrong} (--protocol devrf-forward)")
    folder = OutputFolder(out, made_by("devrf-forward", simulation))
    path = out / "scene.yaml"
    if folder.complete:
        return Made(path, 0)
    times = np.linspace(0, 1, options.times)
    model = _facing(scene, seed, options)
    studio = Studio(options.spp)
    film = MomentCache(studio, (*model, _wall(seed)), times)
    alone = MomentCache(studio, model, times)  # for the matte
    folder.begin()
    places = np.array([*PLACES[:cameras], TEST_PLACE])
    fixed = [_camera(size, options, place, np.zeros(2)) for place in places]
    sweep = [_sweep_camera(seed, i, size, options) for i in range(options.static_views)]
    dynamic = f"dynamic_{len(fixed)}views"
    total = len(sweep) + len(fixed) * (1 + options.times)
    rendered = done = 0

    def shoot(file: str, camera: Camera, moment: int) -> None:
        nonlocal rendered, done
        if not folder.has(file):
            sample_seed = folder.seed_of(file.replace(dynamic, "dynamic"))
            rgba = film.stage(moment).picture(camera, sample_seed)
            matte = alone.stage(moment).coverage(camera, sample_seed)
            rgba[..., 3] = np.rint(255 * matte.clip(0, 1)).astype(np.uint8)
            folder.picture(file, rgba)
            rendered += 1
        done += 1
        progress(done / total, f"{file}: picture {done} of {total}")

    bounds = []
    for i, camera in enumerate([*sweep, *fixed]):
        shoot(f"static/images/{i:03d}.png", camera, 0)
        depth = film.surface(0, f"static{i}", camera).depth
        bounds.append([depth[depth > 0].min(), depth.max()])
    poses = llff_poses([*sweep, *fixed])
    folder.array("static/poses_bounds.npy", np.column_stack([poses.reshape(len(poses), 15), bounds]))
    for moment in range(options.times):
        for k, camera in enumerate(fixed, start=1):
            view = f"{dynamic}/view{k}"
            shoot(f"{view}/images/{moment:03d}.png", camera, moment)
            depth, flow = f"{view}/depth/{moment:03d}.npz", f"{view}/images_flow/{moment:03d}_bwd.npz"
            film.write_truth(folder, moment, view, camera, depth, flow)
    poses, bounds = normalised(poses, np.array(bounds))
    folder.array(f"{dynamic}/poses.npy", poses)
    folder.array(f"{dynamic}/bds.npy", bounds)
    folder.text("scene.yaml", scene_yaml(scene, "devrf"))
    folder.finish()
    return Made(path, rendered)


def llff_poses(cameras: list[Camera]) -> Float[np.ndarray, "n 3 5"]:
    """World-from-camera in LLFF's axes (down, right, back), then the column height, width, focal length."""
    rows = []
    for camera in cameras:
        right, up, back, centre = (camera.world_from_cam @ FLIP_YZ)[:3].T
        rows.append(np.stack([-up, right, back, centre, [camera.height, camera.width, camera.K[0, 0]]], -1))
    return np.array(rows)


def normalised(
    poses: Float[np.ndarray, "n 3 5"], bounds: Float[np.ndarray, "n 2"]
) -> tuple[Float[np.ndarray, "n 3 5"], Float[np.ndarray, "n 2"]]:
    """What LLFF's loader makes of `poses_bounds.npy`, and the published dynamic sets store.

    Axes become right, up, back; lengths are divided by three quarters of the nearest bound; the world is moved
    into the frame of the mean pose.

    Returns:
        Poses [N, 3, 5] and bounds [N, 2].
    """
    poses = np.concatenate([poses[..., 1:2], -poses[..., 0:1], poses[..., 2:]], -1)
    scale = 1 / (bounds.min() * MARGIN)
    poses[..., 3] *= scale
    back = poses[..., 2].sum(0) / np.linalg.norm(poses[..., 2].sum(0))
    right = np.cross(poses[..., 1].sum(0), back)
    right /= np.linalg.norm(right)
    mean = np.eye(4)
    mean[:3] = np.stack([right, np.cross(back, right), back, poses[..., 3].mean(0)], -1)
    full = np.tile(np.eye(4), (len(poses), 1, 1))
    full[:, :3] = poses[..., :4]
    moved = (np.linalg.inv(mean) @ full)[:, :3]
    return np.concatenate([moved, poses[..., 4:]], -1), bounds * scale


def _facing(scene: str, seed: int, options: ForwardOptions) -> Model:
    """The model, turned so that it is seen from its best side."""
    kind = MODELS[scene]
    R = turn("z", -90 - kind.face_deg)[:3, :3]

    def turned(part: Part) -> Part:
        rest = replace(part.rest, vertices=part.rest.vertices @ R.T)
        return Part(rest, lambda time: part.vertices_at(time) @ R.T)

    return tuple(turned(p) for p in kind.build(np.random.default_rng([seed, 0]), options.motion_scale))


def _wall(seed: int) -> Part:
    h, texels = WALL_HALF, round(2 * WALL_HALF / WALL_TEXEL)
    rng = np.random.default_rng([seed, 3])
    picture = texture(rng, (texels, texels), WALL_TEXEL, 1.0, paint=WALL, sizes_m=(0.08, 0.8))
    quad = np.array([[x, WALL_Y, z] for x, z in ((-h, h), (h, h), (h, -h), (-h, -h))])
    return rigid(picture_on_quad(quad, picture), np.eye(4))


def _sweep_camera(seed: int, number: int, size: tuple[int, int], options: ForwardOptions) -> Camera:
    """Rows from side to side, as a hand moves a camera."""
    rng = np.random.default_rng([seed, 2, number])
    columns = max(1, round(np.sqrt(options.static_views / 0.6)))
    rows = -(-options.static_views // columns)
    row, column = divmod(number, columns)
    x = 2 * (column + 0.5) / columns - 1
    y = 2 * (row + 0.5) / rows - 1
    place = np.array([x if row % 2 == 0 else -x, y]) + rng.uniform(-0.1, 0.1, 2)
    return _camera(size, options, place, WOBBLE_DEG * rng.uniform(-1, 1, 2))


def _camera(size: tuple[int, int], options: ForwardOptions, place: np.ndarray, aim_deg: np.ndarray) -> Camera:
    right, up = place * options.spread / 2 * [1.0, 0.6]
    position = np.array([right, -DISTANCE, up])
    ahead = np.array([np.tan(np.radians(aim_deg[0])), 1.0, np.tan(np.radians(aim_deg[1]))])
    return Camera(*size, lens(size), look_at(position, position + ahead))
