"""Render a raw session, as a crew would bring it home, with known truth.

A textured room with an object that deforms: at rest for one moving camera (the sweep), then in motion for
fixed, free-running cameras and a witness, with claps, a ChArUco board, lens distortion, noise and unequal
exposure. `simulate_session` writes

    static.mp4, cam0.mp4, ..., witness.mp4      pictures (H.264) with their own clocks' times, and sound (AAC)
    charuco_static.mp4, charuco_cam0.mp4, ...   the board before each camera alone
    ground_truth.json                           what is true; OpenCV's conventions, metres, seconds
    witness_mask.npz, object_points.npz         where something moves in the witness's pictures; the object's way
    scene.yaml                                  ready for `devrf-pipeline run`

`ground_truth.json` holds, besides what docs/formats.md promises: `sweep` (K, k1 of the moving camera), per
camera `K`, `k1`, `gain`, `clapper_distance_m` and `file_times_s`, `claps` (place and times), `object` (some
of the object's surface points at times on cam0's clock) and `made_by` (scene, seed, options, code). K's have
the centre of the first pixel at 0, unlike `Camera`, which has it at 0.5. The same arguments give the same
session, up to what the video encoder makes of the same pictures.
"""

import json
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from devrf.capture.camera import Camera
from devrf.capture.system.errors import InputError
from devrf.capture.system.progress import Progress, no_progress
from devrf.capture.system.writable import check_folder
from devrf.lab.simulate.render.daylight import DAYLIGHT, lit
from devrf.lab.simulate.render.mitsuba import load_mitsuba
from devrf.lab.simulate.render.renderer import Finish, Light, Renderer
from devrf.lab.simulate.render.sensor import (
    BoardCamera,
    ClipWriter,
    board_corners,
    board_picture,
    board_poses,
    expose,
)
from devrf.lab.simulate.scenes.catalogue import (
    WOOD,
    Mesh,
    MovingObject,
    Paint,
    Room,
    picture_on_quad,
    room,
    texture,
)
from devrf.lab.simulate.scenes.furniture import furnished
from devrf.lab.simulate.scenes.objects import OBJECTS, make_object
from devrf.lab.simulate.scenes.session_options import SessionOptions
from devrf.lab.simulate.scenes.simulation import Simulation
from devrf.lab.simulate.scenes.workshop import OAK, workshop_room
from devrf.lab.simulate.session import sound
from devrf.lab.simulate.session.camera_rig import (
    BOARD_SQUARE_M,
    BOARD_SQUARES,
    FixedCamera,
    board_pose,
    fixed_cameras,
    rate_hz,
    sweep_cameras,
)
from devrf.lab.simulate.session.moved import MovedMasks, ways
from devrf.lab.simulate.session.session_files import (
    background_at,
    clapper_distance_m,
    ground_truth,
    lamp_shift_m,
    object_at,
    scene_yaml,
    swaying,
)

SCENES = {name: kind.about for name, kind in OBJECTS.items()}
BOARD_FPS = 2.0
BOARD_THICKNESS_M = 0.012
CLAP_MARGIN_S = 0.03  # between a clap and the ends of what all cameras record
EXPOSED = 6  # moments of an exposure that takes time: a limb at 4 m/s goes less than a pixel between two


def simulate_session(
    out: Path,
    simulation: Simulation[SessionOptions],
    *,
    kept: Sequence[Path] = (),
    code: str | None = None,
    progress: Progress = no_progress,
) -> Path:
    """Render a raw session with known truth.

    Args:
        out: Folder to write; new or empty.
        simulation: Of a scene out of `SCENES`, its pictures of even numbers of pixels.
        kept: Clips of another session that this simulation would not change; they are copied, not rendered.
        code: Version of this simulator's code, for the record; None: not known.
        progress: Told after every picture.
    Returns:
        The scene.yaml.
    Raises:
        InputError: Unknown scene, odd size, folder not empty, or mitsuba not installed.
    """
    check_simulation(simulation)
    options, size = simulation.options, simulation.size
    _check_folder(out)
    load_mitsuba()
    seeds = np.random.default_rng(simulation.seed).spawn(6)
    daylight = options.room == "workshop"
    around = room_of(seeds[0], options)
    thing = make_object(simulation.scene, seeds[1], options)
    still = [*around.still, *thing.stand]
    if options.board:
        still += standing_board(seeds[2], options, OAK if daylight else WOOD)
    fixed = fixed_cameras(seeds[3], simulation.cameras, size, options)
    sweep = sweep_cameras(seeds[4], size, options)
    light = DAYLIGHT if daylight else Light()
    if daylight:
        still = lit(still, light, _seed(seeds[0]))
    renderer = Renderer(still, options.spp, Finish(options.gloss, options.clear), light)

    out.mkdir(parents=True, exist_ok=True)
    names = ["static", *(camera.name for camera in fixed)]
    clips = [f"{kind}{name}.mp4" for kind in ("", "charuco_") for name in names]
    # One generator for each: a clip is the same whatever others are kept, and whether there are boards or sound.
    noise = dict(zip(clips, seeds[5].spawn(len(clips)), strict=True))
    there = {path.name: path for path in kept}
    work = _Work(out, renderer, thing, around.behind, options, size, noise, there, progress)
    work.total = len(sweep) + sum(len(camera.file_times_s) for camera in fixed)
    work.total += (len(fixed) + 1) * options.board_frames * options.board + len(fixed[-1].file_times_s)
    work.sweep(sweep)
    claps = _clap_times(seeds[2], fixed, options)
    burst = sound.make_burst(seeds[2])
    for number, camera in enumerate(fixed):
        work.clip(number, camera, claps, burst)
    if options.board:
        for name, camera in [("static", _away_from_board(sweep)), *((c.name, c.camera) for c in fixed)]:
            work.board_clip(name, camera)
    made_by = {"scene": simulation.scene, "seed": simulation.seed, "options": options.model_dump(mode="json")}
    truth = ground_truth(sweep, fixed, claps, thing, options, made_by | {"code": code})
    (out / "ground_truth.json").write_text(json.dumps(truth) + "\n", encoding="utf-8")
    work.motion(fixed[-1], still)
    path = out / "scene.yaml"
    path.write_text(scene_yaml(simulation.scene, fixed, options), encoding="utf-8")
    return path


def check_simulation(simulation: Simulation[SessionOptions]) -> None:
    """Refuse what `simulate_session` cannot render, wherever it is to be written.

    Raises:
        InputError: Unknown scene, odd size, or options that do not fit together.
    """
    scene, cameras, size = simulation.scene, simulation.cameras, simulation.size
    options = simulation.options
    if scene not in SCENES:
        text = f"simulate --scene {scene}: unknown scene, expected one of {', '.join(SCENES)} (--protocol session)"
        raise InputError("scene-unknown", text)
    if not 1 <= cameras <= 64:
        raise InputError("option-out-of-range", f"simulate --cameras {cameras}: expected 1 to 64")
    if any(n < 16 or n % 2 for n in size):
        text = f"simulate --size {size[0]}x{size[1]}: expected even numbers of at least 16 (H.264 in yuv420p)"
        raise InputError("option-out-of-range", text)
    if options.duration_s <= 2 * options.offset_range_s:
        wrong = (
            f"duration_s {options.duration_s} is not more than twice offset_range_s {options.offset_range_s}"
        )
        text = f"simulate: {wrong}; the clips would not overlap, raise duration_s"
        raise InputError("options-contradict", text)
    if options.strip_m and scene != "sheet":
        wrong = f"simulate: strip_m {options.strip_m}: only a sheet is cut into strips"
        raise InputError("options-contradict", f"{wrong}, expected --scene sheet")


def room_of(rng: np.random.Generator, options: SessionOptions) -> Room:
    """What stands around the object, and what moves behind it."""
    if options.room == "workshop":
        return workshop_room(rng, options.texture_contrast)
    if options.room == "patterned":
        return room(rng, options.texture_contrast)
    return furnished(options.room, rng, options.texture_contrast)


def _check_folder(out: Path) -> None:
    check_folder(out, "simulate")
    if out.exists() and any(out.iterdir()):
        raise InputError("folder-exists", f"simulate {out}: not an empty folder; give a new one or empty it")


@dataclass
class _Work:
    """Renders and writes clips, and counts pictures."""

    out: Path
    renderer: Renderer
    thing: MovingObject
    behind: list[Mesh]
    options: SessionOptions
    size: tuple[int, int]
    noise: dict[str, np.random.Generator]
    kept: dict[str, Path]
    progress: Progress
    total: int = 1
    done: int = 0

    def sweep(self, path: list[Camera]) -> None:
        options, name = self.options, "static.mp4"
        if self._copied(name, len(path)):
            return
        rng, clip = self.noise[name], ClipWriter(self.out / name, self.size, options.sweep_fps, options.crf)
        for i, camera in enumerate(path):
            file_time_s = i / options.sweep_fps
            thing = object_at(self.thing, options.rest_s + file_time_s, options, options.sweep_motion)
            thing = swaying(thing, file_time_s, options.sway_m)
            radiance = self.renderer(camera, [thing], _seed(rng), beside=self.behind)
            clip.picture(expose(radiance, 1.0, options.noise, rng), file_time_s)
            self._tick(name)
        clip.close()

    def clip(self, number: int, camera: FixedCamera, claps_s: np.ndarray, burst: np.ndarray) -> None:
        rate = sound.SAMPLE_RATE_HZ if self.options.sound else None
        name = f"{camera.name}.mp4"
        if self._copied(name, len(camera.file_times_s)):
            return
        rng, of_sound = self.noise[name].spawn(2)
        fps = rate_hz(number, self.options)
        size = camera.camera.width, camera.camera.height
        clip = ClipWriter(self.out / name, size, fps, self.options.crf, rate)
        if self.options.sound:
            microphone = sound.Microphone(
                distance_m=clapper_distance_m(camera),
                offset_s=camera.offset_s,
                drift_ppm=camera.drift_ppm,
                gain=float(of_sound.uniform(0.4, 1.0)),
            )
            duration_s = float(camera.file_times_s[-1]) + 1 / fps
            clip.sound(sound.record(of_sound, burst, claps_s, microphone, duration_s))
        for file_time_s in camera.file_times_s:
            radiance = self._exposed(camera, camera.true_time(float(file_time_s)), rng)
            clip.picture(expose(radiance, camera.gain, self.options.noise, rng), float(file_time_s))
            self._tick(name)
        clip.close()

    def _exposed(self, camera: FixedCamera, middle_s: float, rng: np.random.Generator) -> np.ndarray:
        """The light of an exposure: the mean of moments of it, where it takes time."""
        parts = EXPOSED if self.options.exposure_s else 1
        shares = (np.arange(parts) + 0.5) / parts - 0.5
        found = []
        for moment in (middle_s + self.options.exposure_s * shares).tolist():
            found.append(
                self.renderer(
                    camera.camera,
                    [object_at(self.thing, moment, self.options)],
                    _seed(rng),
                    beside=background_at(self.behind, moment, self.options),
                    lamp_shift_m=lamp_shift_m(moment, self.options),
                    moments=parts,
                )
            )
        return sum(found[1:], start=found[0]) / parts

    def board_clip(self, name: str, camera: Camera) -> None:
        options, file = self.options, f"charuco_{name}.mp4"
        rng = self.noise[file]
        backdrop = self.renderer(camera, [self.thing.rest], _seed(rng), beside=self.behind)
        show = BoardCamera(camera, backdrop, BOARD_SQUARES, BOARD_SQUARE_M)
        poses = board_poses(rng, camera, BOARD_SQUARES, BOARD_SQUARE_M, options.board_frames)
        clip = ClipWriter(self.out / file, (camera.width, camera.height), BOARD_FPS, options.crf)
        for i, pose in enumerate(poses):
            clip.picture(expose(show(pose), 1.0, options.noise, rng), i / BOARD_FPS)
            self._tick(file)
        clip.close()

    def motion(self, witness: FixedCamera, still: Sequence[Mesh]) -> None:
        """Where something moves in the witness's pictures, and where points of the object's surface are then."""
        moments = [witness.true_time(float(t)) for t in witness.file_times_s]
        objects = [object_at(self.thing, moment, self.options) for moment in moments]
        np.savez_compressed(self.out / "object_points.npz", times_s=np.array(moments), points_m=ways(objects))
        masks, moved = MovedMasks(witness.camera, [self.thing.rest, *self.behind], still), []
        for moment, mesh in zip(moments, objects, strict=True):
            moved.append(masks([mesh, *background_at(self.behind, moment, self.options)]))
            self._tick(f"what moves before {witness.name}")
        np.savez_compressed(self.out / f"{witness.name}_mask.npz", mask=np.stack(moved))

    def _copied(self, name: str, pictures: int) -> bool:
        """Whether the clip was there already; then it is now here too."""
        if name not in self.kept:
            return False
        shutil.copyfile(self.kept[name], self.out / name)
        self.done += pictures
        return True

    def _tick(self, name: str) -> None:
        self.done += 1
        self.progress(self.done / self.total, f"{name}: picture {self.done} of {self.total}")


def _seed(rng: np.random.Generator) -> int:
    """Of the light paths of a picture."""
    return int(rng.integers(2**31))


def standing_board(rng: np.random.Generator, options: SessionOptions, back_paint: Paint = WOOD) -> list[Mesh]:
    """The board in the room during everything, and a textured back so that it does not glow through."""
    pose = board_pose()
    front = board_corners(BOARD_SQUARES, BOARD_SQUARE_M, pose)
    back = (front + BOARD_THICKNESS_M * pose[:3, 2])[[1, 0, 3, 2]]
    paper = texture(rng, (120, 160), 0.004, options.texture_contrast, paint=back_paint, sizes_m=(0.03, 0.2))
    return [picture_on_quad(front, board_picture(BOARD_SQUARES)), picture_on_quad(back, paper)]


def _away_from_board(sweep: list[Camera]) -> Camera:
    """A pose that does not see the standing board's face: in its own clip the board must be there once."""
    pose = board_pose()
    return min(sweep, key=lambda camera: float((pose[:3, 3] - camera.centre) @ pose[:3, 2]))


def _clap_times(rng: np.random.Generator, fixed: list[FixedCamera], options: SessionOptions) -> np.ndarray:
    """Claps within what all cameras record; their sound needs a few milliseconds to arrive."""
    from_s = max(camera.offset_s for camera in fixed) + CLAP_MARGIN_S
    to_s = min(camera.true_time(float(camera.file_times_s[-1])) for camera in fixed) - 2 * CLAP_MARGIN_S
    return sound.clap_times(rng, options.claps, from_s, to_s)
