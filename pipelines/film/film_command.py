"""`devrf-pipeline render` with options: check everything, make the film, say where it is and what to expect of it."""

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from devrf.capture.formats.parts.export import new_folder
from devrf.capture.formats.parts.opengl import opengl_pose
from devrf.capture.formats.parts.scene_files import read_scene
from devrf.capture.scene import Scene
from devrf.capture.system.durable import write_json
from devrf.capture.system.errors import DevrfError, InputError
from devrf.pipelines.budget.at_once import FILM, RENDERED, WITH_DEPTH
from devrf.pipelines.budget.memory import too_much
from devrf.pipelines.film.film_plan import FilmRequest, Plan, planned
from devrf.pipelines.inputs.device import resolve_device
from devrf.pipelines.run_folder.outcomes import check_made, refusals
from devrf.pipelines.run_folder.output_folder import output_folder
from devrf.pipelines.runner.failure import is_no_memory
from devrf.pipelines.runner.run_state import Run
from devrf.pipelines.runner.stale import said_of_stale, stale_stages
from devrf.pipelines.stages import stage_names
from devrf.pipelines.stages.render import SIZES
from devrf.pipelines.stamps.stamp import STAMP
from devrf.pipelines.terminal.console import duration
from devrf.pipelines.terminal.disk_errors import disk_told

if TYPE_CHECKING:  # they need torch
    from devrf.reconstruct.film.depth_layer import DepthScale
    from devrf.reconstruct.rendering.model import DynamicModel

READS = ("scene", "canonical", "deformation")  # the stages whose results are filmed
KIND = "film"  # of folders that may be replaced


def film(job: Run, asked: FilmRequest, device: str) -> Path:
    """Make a film of a run and say where it is; what is stopped leaves nothing, and an earlier film as it was.

    Args:
        job: The run.
        asked: The options.
        device: auto, cpu or cuda.
    Raises:
        InputError: An option that cannot be, a run without a model, a folder in use.
        DevrfError: It cannot be written, or not enough memory is left.
    """
    asked.check()
    talk = job.talk
    folder = output_folder(job.run_dir, asked.out, f"films/{asked.name}", KIND)
    check_made(job.run_dir, READS[:2])
    world = read_scene(job.run_dir / "scene")
    moves = (job.run_dir / "deformation" / STAMP).is_file()
    plan = planned(asked, world, moves, SIZES[job.config.preset][2])
    layers = asked.layer_names()
    _check_memory(job, plan, layers)
    job.device = resolve_device(device, job.config.budget.gpu_memory_gb)
    notes = _state(job)
    for line in notes:
        talk.say(f"  note: {line}", style="yellow")
    with _told(folder):
        made_in_s = _make(job, asked, plan, world, folder, notes)
    count = len(plan.cameras)
    shown = f"{count / made_in_s:.3g} pictures a second"
    talk.say(f"  {count} pictures, {count / plan.fps:.3g} s, in {duration(made_in_s)} ({shown})")
    for layer in layers:
        talk.say(f"  film: {folder / layer}{'' if asked.format == 'png' else '.mp4'}")
    return folder


def _make(
    job: Run, asked: FilmRequest, plan: Plan, world: Scene, folder: Path, notes: Sequence[str]
) -> float:
    """Write the film and `film.json`; seconds that it took."""
    from devrf.reconstruct.film.depth_layer import DepthScale
    from devrf.reconstruct.film.film_maker import Film, make_film
    from devrf.reconstruct.storage.model_io import load_model

    model = _showing(load_model(job.run_dir, job.device), asked.left_out())
    world_per_box = 1 / float(np.cbrt(np.linalg.det(world.box_from_world[:3, :3])))
    depth = DepthScale.of(plan.cameras, world.aabb, model.rest.near, world_per_box, world.metric)
    names = {layer: layer for layer in asked.layer_names()}
    film = Film(plan.cameras, plan.times, plan.fps, names, asked.format or "mp4", depth)
    with new_folder(folder, KIND) as new, job.talk.progress(f"film {folder.name}") as progress:
        begin = time.perf_counter()
        make_film(film, model, new, progress)
        made_in_s = time.perf_counter() - begin
        about = {**_about(asked, plan, world, depth), "notes": list(notes), "made_in_s": round(made_in_s, 3)}
        write_json(new / "film.json", about)
    return made_in_s


def _about(asked: FilmRequest, plan: Plan, world: Scene, depth: "DepthScale") -> dict[str, Any]:
    """What there is to know of the film; also a camera path that nerfstudio, and `--path`, read again."""
    world_from_box = np.linalg.inv(world.box_from_world)
    shown = {"unit": depth.unit, "metres": world.metric, "near": depth.near, "far": depth.far}
    entries = []
    for camera, at in zip(plan.cameras, plan.times, strict=True):
        pose = np.array(opengl_pose(camera.moved(world_from_box))).reshape(-1).tolist()
        fov, aspect = float(np.degrees(camera.fov_y)), camera.width / camera.height
        entry = {"camera_to_world": pose, "fov": fov, "aspect": aspect}
        entries.append(entry if at is None else entry | {"render_time": at})
    count, length_s = len(entries), world.t1_s - world.t0_s
    return {
        "path": asked.path or "orbit",
        "frames": count,
        "fps": plan.fps,
        "seconds": count / plan.fps,
        "times_s": [None if at is None else world.t0_s + at * length_s for at in plan.times],
        "layers": {layer: shown if layer == "depth" else {} for layer in asked.layer_names()},
        "without": asked.left_out(),
        "camera_type": "perspective",
        "render_width": plan.cameras[0].width,
        "render_height": plan.cameras[0].height,
        "camera_path": entries,
    }


def _showing(model: "DynamicModel", without: tuple[int, ...]) -> "DynamicModel":
    """The model without some of its parts."""
    if not without:
        return model
    said = f"--without {','.join(map(str, without))}"
    if model.movers is None:
        raise InputError("option-misplaced", f"{said}: what moves in this scene is not made of parts")
    count = model.movers.parts
    if max(without) > count:
        text = f"{said}: expected parts of 1 to {count}; the report lists them"
        raise InputError("option-out-of-range", text)
    return model.showing(True, [part for part in range(1, count + 1) if part not in without])


def _state(job: Run) -> list[str]:
    """What is to be known of the run: unfinished, stale or unhealthy."""
    last = READS[-1]
    lines = refusals(job.run_dir, stage_names())
    if not (job.run_dir / last).is_dir():
        lines.append(f"{last} is not made yet: the film shows the scene at rest")
    return [*lines, *said_of_stale(stale_stages(job, last))]


def _check_memory(job: Run, plan: Plan, layers: Sequence[str]) -> None:
    camera, each = plan.cameras[0], WITH_DEPTH if "depth" in layers else RENDERED
    needed = FILM + each * max(camera.width * camera.height for camera in plan.cameras)
    if (wrong := too_much(job.config, needed)) is not None:
        text = f"pictures of {camera.width}x{camera.height} need {wrong}; choose a smaller --size"
        raise InputError("film-needs-memory", text)


@contextmanager
def _told(folder: Path) -> Iterator[None]:
    """A disk that is full, or memory, in words."""
    try:
        with disk_told(folder, "make room, or name another folder with --out"):
            yield
    except Exception as error:
        if not is_no_memory(error):
            raise
        text = "not enough memory for pictures of this size; choose a smaller --size"
        raise DevrfError("no-memory", text) from None
