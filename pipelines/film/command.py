"""`devrf-pipeline render` with options: check everything, make the film, say where it is and what to expect of it."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from devrf.capture.amounts import size_text
from devrf.capture.durable import write_json
from devrf.capture.errors import CaptureError, DevrfError, InputError
from devrf.capture.scene import Scene
from devrf.capture.writable import check_folder
from devrf.pipelines.budget.memory import allowed_bytes, memory_bound
from devrf.pipelines.console import Talk, duration
from devrf.pipelines.device import resolve_device
from devrf.pipelines.disk_told import disk_told
from devrf.pipelines.film.about import FILM, READS, film_json, made_from_of, read_made_from
from devrf.pipelines.film.asked import Asked
from devrf.pipelines.film.plan import Film, planned
from devrf.pipelines.run_command import said_of_stale, stale
from devrf.pipelines.runner.failure import is_no_memory
from devrf.pipelines.runner.lock import Lock
from devrf.pipelines.runner.own_folder import check_run_folder
from devrf.pipelines.runner.plan import read_health
from devrf.pipelines.runner.run import Run
from devrf.pipelines.runner.signals import stopped_by_signals
from devrf.pipelines.stages import STAGES
from devrf.pipelines.stages.render import SIZES
from devrf.pipelines.stamps.stamp import STAMP
from devrf.pipelines.trained_scene import trained_scene
from devrf.pipelines.unknown_clocks import unknown_clock_notes, unknown_clocks

if TYPE_CHECKING:  # it needs torch
    from devrf.reconstruct.model import DynamicModel

BASE_BYTES = 900_000_000  # the process while it unpacks a model: the example's
# That a picture's pixel takes while it is rendered; measured: 136 before white, surroundings more.
PIXEL_BYTES = 230
LAYER_BYTES = 100  # and for each other layer; measured: 61 for depth and flow together
GOES_ON = "what was made is kept, and the same command goes on from there"


class Stopped(Exception):
    """The user ended it."""


def film(talk: Talk, job: Run, asked: Asked, device: str) -> Path:
    """Make a film of a run and say where it is.

    Args:
        talk: Where to speak.
        job: The run.
        asked: The options.
        device: auto, cpu or cuda.
    Raises:
        InputError: An option that cannot be, a run without a model, a folder in use.
        DevrfError: It cannot be written, or not enough memory is left.
        Stopped: By Ctrl-C or SIGTERM.
    """
    asked.check()
    folder = _folder(job, asked)
    _check_made(job)
    world = trained_scene(job.run_dir)
    moves = (job.run_dir / "deformation" / STAMP).is_file()
    plan = planned(asked, world, moves, SIZES[job.config.preset][2])
    _check_memory(job, plan)
    job.device = resolve_device(device, job.config.budget.gpu_memory_gb)
    beside = {frame.camera_name for frame in plan.beside}
    notes = _state(job) + unknown_clock_notes(unknown_clocks(job.run_dir), beside)
    for line in notes:
        talk.say(f"  note: {line}", style="yellow")
    made_from = made_from_of(job.run_dir, plan)
    if read_made_from(folder / FILM) == made_from:
        talk.say(f"  film: {folder} is made of the same model with the same options; nothing to do")
        return folder
    with stopped_by_signals(), _told(folder):
        _make(talk, job, plan, world, folder, made_from, notes)
    return folder


def _make(
    talk: Talk, job: Run, plan: Film, world: Scene, folder: Path, made_from: str, notes: list[str]
) -> None:
    from devrf.pipelines.film.draw import Drawer
    from devrf.pipelines.film.kept import Kept
    from devrf.pipelines.film.make import finish, make
    from devrf.pipelines.trained_model import load_trained
    from devrf.reconstruct.film.layers import DepthScale

    model = _showing(load_trained(job.run_dir, job.device), plan.without)
    for line in (left := _leaving(plan, model)):
        talk.say(f"  note: {line}", style="yellow")
    world_per_box = 1 / float(np.cbrt(np.linalg.det(world.box_from_world[:3, :3])))
    depth = DepthScale.of(plan.cameras, world.aabb, model.rest.near, world_per_box, world.metric)
    kept = Kept.beside(folder)
    kept.folder.mkdir(parents=True, exist_ok=True)
    lock = Lock(kept.folder, talk.say)
    lock.take()
    try:
        if kept.begin(made_from):
            talk.say("  an unfinished film of the same name, of another model or other options, is gone")
        there = kept.count(plan.layers[0])
        if there:
            talk.say(f"  going on: {there} of {plan.count} pictures are there")
        drawer = Drawer(plan, model, depth)
        try:
            with talk.progress(f"film {folder.name}") as progress:
                made = make(drawer, kept, progress)
        except KeyboardInterrupt:
            there = kept.count(plan.layers[0])
            raise Stopped(f"stopped; {there} of {plan.count} pictures: {GOES_ON}") from None
        write_json(kept.folder / FILM, film_json(plan, world, drawer, made, made_from, notes + left))
    finally:
        lock.release()
    finish(drawer, kept, folder)
    shown = f"{made.rendered / made.seconds:.3g} pictures a second" if made.rendered else "all pictures kept"
    talk.say(f"  {plan.count} pictures, {plan.count / plan.fps:.3g} s, in {duration(made.seconds)} ({shown})")
    for path in sorted(folder.iterdir()):
        if path.is_dir() or path.name != FILM:
            talk.say(f"  film: {path}")


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


def _folder(job: Run, asked: Asked) -> Path:
    """Where the film goes; nothing but a film is replaced."""
    if asked.out is None:
        check_run_folder(job.run_dir, ())
        folder = job.run_dir / "films" / asked.name
    else:
        folder = asked.out.expanduser().resolve()
    check_folder(folder, "--out")
    if folder.is_dir() and any(folder.iterdir()) and read_made_from(folder / FILM) is None:
        text = f"--out {folder}: holds files that are no film; name another folder, or empty it"
        raise InputError("folder-exists", text)
    check_folder(folder.parent, "--out")
    return folder


def _check_made(job: Run) -> None:
    missing = [name for name in READS[:2] if not (job.run_dir / name / STAMP).is_file()]
    if missing:
        raise InputError(
            "stage-not-made",
            f"{job.run_dir}: {missing[0]} is not made yet, so there is nothing to film; run the scene first "
            "(devrf-pipeline run)",
        )


def _state(job: Run) -> list[str]:
    """What is to be known of the run: unfinished, stale or unhealthy."""
    lines = []
    for stage in STAGES:
        failed = [row.check for row in read_health(job.run_dir / stage.name) if row.verdict == "fail"]
        if failed:
            lines.append(f"{stage.name} is unhealthy: {'; '.join(failed)}")
        if stage.name not in READS:
            continue
        if not (job.run_dir / stage.name).is_dir():
            lines.append(f"{stage.name} is not made yet: the film shows the scene at rest")
    return [*lines, *said_of_stale(stale(job, READS[-1]))]


def _check_memory(job: Run, plan: Film) -> None:
    pixels = max(camera.width * camera.height for camera in plan.cameras)
    each = PIXEL_BYTES + LAYER_BYTES * (len(plan.layers) - 1)
    needed, allowed = BASE_BYTES + each * pixels, allowed_bytes(job.config)
    if needed > allowed:
        camera = plan.cameras[0]
        raise InputError(
            "film-needs-memory",
            f"pictures of {camera.width}x{camera.height} need about {size_text(needed)} of memory, and "
            f"{size_text(allowed)} are allowed ({memory_bound(job.config, allowed)}); choose a smaller --size",
        )


def _leaving(plan: Film, model: "DynamicModel") -> list[str]:
    """What is to be said of where the path leads.

    Raises:
        InputError: From some places nothing can be shown.
    """
    from devrf.reconstruct.film.leaving import FREE_DEG, leaving

    found = leaving(plan.scene, model, plan.cameras, plan.times)
    count = plan.count
    if found.unseen:
        first = found.unseen[0]
        raise InputError(
            "film-path-blind",
            f"--path {plan.path}: {len(found.unseen)} of {count} pictures cannot be rendered, the first is {first} (at "
            f"{first / plan.fps:.2f} s): the camera is inside of something solid, or farther from "
            f"the scene's box than any camera saw ({model.rest.far:.3g} box units); move the path nearer to where "
            "cameras stood",
        )
    notes = []
    if found.outside:
        notes.append(
            f"{found.outside} of {count} pictures look from where no training camera looked from (up to "
            f"{found.farthest_deg:.0f} degrees away; more than {FREE_DEG:g}, or much nearer or farther, counts): what "
            "they show is guessed"
        )
    if found.cut:
        notes.append(
            f"in {found.cut} of {count} pictures something is nearer than {model.rest.near:.3g} box units, where "
            "nothing is shown: it is cut open"
        )
    return notes


@contextmanager
def _told(folder: Path) -> Iterator[None]:
    """A disk that is full, in words."""
    try:
        with disk_told(folder, f"make room, or name another folder with --out; {GOES_ON}"):
            yield
    except CaptureError as error:
        raise DevrfError(error.code, f"{error}; {GOES_ON}") from None
    except Exception as error:
        if not is_no_memory(error):
            raise
        text = f"not enough memory for pictures of this size; choose a smaller --size: {GOES_ON}"
        raise DevrfError("no-memory", text) from None
