"""The commands that look at what a run has made, and take it elsewhere: report, compare, view, render, export."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from devrf.capture.system.errors import InputError
from devrf.capture.system.writable import check_file
from devrf.pipelines.cli import run_command
from devrf.pipelines.run_folder.own_folder import check_run_folder
from devrf.pipelines.runner.run_state import Run
from devrf.pipelines.runner.stale import said_of_stale, stale_stages
from devrf.pipelines.stages import STAGES
from devrf.pipelines.terminal.console import Talk
from devrf.pipelines.terminal.disk_errors import disk_told
from devrf.pipelines.terminal.exit_codes import STOPPED
from devrf.pipelines.terminal.shared_options import (
    DeviceOption,
    PresetOption,
    QuietOption,
    SceneArgument,
    SetOption,
    VerboseOption,
    errors_told,
    talk_of,
)
from devrf.pipelines.terminal.signals import stopped_by_signals


def report(
    scene: SceneArgument,
    preset: PresetOption = None,
    overrides: SetOption = None,
    out: Annotated[
        Path | None,
        typer.Option(help="Write the page to this file instead of the run folder, which may be read-only"),
    ] = None,
    quiet: QuietOption = False,
    verbose: VerboseOption = False,
) -> None:
    """Rebuild the report of a run folder."""
    talk = talk_of(quiet, verbose)
    job = run_command.prepare(talk, scene, preset, overrides, None, check_files=False)
    if out is not None:
        return _report_beside(talk, job, scene, out)
    with errors_told(talk):
        left = _report_is_left(job.run_dir)
    if left:
        talk.say(
            "  note: the run folder may not be written by this user: its report is left as it is",
            style="yellow",
        )
        job.fresh.append("report")
        return run_command.say_where(job)
    done = {stage.name for stage in STAGES if (job.run_dir / stage.name).is_dir()}
    with errors_told(talk):
        stale = stale_stages(job, "render")
    if not stale and {stage.name for stage in job.applying} <= done | {"report"}:
        run_command.only(job, "report", scene)
    from devrf.pipelines.stages.report import report_so_far

    with errors_told(talk):
        if not done:
            raise _nothing_run(job, scene)
        check_run_folder(job.run_dir, ("report",))
        with disk_told(job.run_dir / "report", "make room there"):
            report_so_far(job.config, job.run_dir, stale)
    for line in said_of_stale(stale):
        talk.say(f"  note: {line}", style="yellow")
    job.fresh.append("report")
    run_command.say_where(job)


def compare(
    runs: Annotated[
        list[Path], typer.Argument(help="Run folders, or scene.yaml; all are compared with the first")
    ],
    out: Annotated[Path, typer.Option(help="Folder for compare.json")] = Path("compare"),
    as_json: Annotated[
        Path | None, typer.Option("--json", help="File for programs; default: compare.json in --out")
    ] = None,
    quiet: QuietOption = False,
) -> None:
    """Put finished runs of one scene side by side: what differs, by how much, and whether that is chance."""
    talk = talk_of(quiet)
    from devrf.pipelines.compare import compare_command

    with errors_told(talk):
        compare_command.compare(talk, runs, out, as_json)


def view(
    scene: SceneArgument,
    preset: PresetOption = None,
    overrides: SetOption = None,
    device: DeviceOption = "auto",
    host: Annotated[
        str, typer.Option(help="Address to serve; default: only this machine. 0.0.0.0: the whole network")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=1, max=65535, help="Port to serve")] = 8080,
    allow_host: Annotated[
        list[str] | None,
        typer.Option(help="Additional host name to accept, such as a proxy's (repeatable)"),
    ] = None,
    quiet: QuietOption = False,
) -> None:
    """Walk through the scene in a browser, also while it is being trained (needs the extra `viewer`)."""
    talk = talk_of(quiet)
    job = run_command.prepare(talk, scene, preset, overrides, None, check_files=False)
    from devrf.pipelines.viewer import command as viewer_command
    from devrf.pipelines.viewer.own_address import Address

    with errors_told(talk):
        viewer_command.view(job, device, Address(host, port, allow_host or ()))


def render(
    scene: SceneArgument,
    path: Annotated[
        str | None,
        typer.Option(
            help="orbit, spiral, still:CAMERA, or a JSON file (nerfstudio's camera_path.json). Default: orbit"
        ),
    ] = None,
    time: Annotated[
        str | None,
        typer.Option(help="Freeze time at this moment: 0 to 1 of the clip, or seconds, such as 1.2s"),
    ] = None,
    seconds: Annotated[
        float | None,
        typer.Option(help="Length of the film; the whole clip is stretched to it. Default: the clip's"),
    ] = None,
    fps: Annotated[float | None, typer.Option(help="Pictures a second; default: 24")] = None,
    size: Annotated[str | None, typer.Option(help="WIDTHxHEIGHT; default: by the preset")] = None,
    layers: Annotated[str | None, typer.Option(help="colour, depth or colour,depth. Default: colour")] = None,
    without: Annotated[
        str | None, typer.Option(help="Leave out parts that move, by their numbers in the report: 2 or 1,3")
    ] = None,
    film_format: Annotated[
        str | None,
        typer.Option("--format", help="mp4 (H.264, default) or png (pictures; depth in 16 bits)"),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder to write; default: films/NAME in the run, by the options")
    ] = None,
    preset: PresetOption = None,
    overrides: SetOption = None,
    device: DeviceOption = "auto",
    quiet: QuietOption = False,
    verbose: VerboseOption = False,
) -> None:
    """Render a film; without options, render the run's standard film again (docs/film.md)."""
    talk = talk_of(quiet, verbose)
    from devrf.pipelines.film import film_command as command
    from devrf.pipelines.film.film_plan import FilmRequest

    asked = FilmRequest(path, time, seconds, fps, size, layers, without, film_format, out)
    job = run_command.prepare(talk, scene, preset, overrides, None, check_files=asked.nothing)
    if asked.nothing:
        run_command.only(job, "render", scene, device)
    with errors_told(talk), _stopped_told(talk, "film"):
        command.film(job, asked, device)


def export(
    scene: SceneArgument,
    dataset_format: Annotated[
        str,
        typer.Option(
            "--format",
            help="data sets: nerfstudio or colmap; the model: ply (point clouds), glb (an animated mesh), splat (3D "
            "Gaussians) or player (a page); only cameras: rig-caliscope, rig-colmap or rig-opencv",
        ),
    ],
    out: Annotated[
        Path | None, typer.Option(help="Folder to write; default: export/FORMAT in the run")
    ] = None,
    times: Annotated[
        str | None,
        typer.Option(
            help="The model: a number of times, keys (the model's own), or times such as 0.5s,1.25s. Default: 10; "
            "glb and player: keys"
        ),
    ] = None,
    level: Annotated[
        float | None, typer.Option(help="glb: opacity of the surface, 0 to 1; default: 0.5")
    ] = None,
    splats: Annotated[
        int | None, typer.Option(help="splat, player: how many Gaussians at most; default: 30000")
    ] = None,
    preset: PresetOption = None,
    overrides: SetOption = None,
    device: Annotated[str | None, typer.Option(help="The model: auto (default), cpu or cuda")] = None,
    quiet: QuietOption = False,
) -> None:
    """Write the calibrated scene as a data set, the trained model as geometry, or the cameras as a calibration."""
    talk = talk_of(quiet)
    job = run_command.prepare(talk, scene, preset, overrides, None, check_files=False)
    from devrf.pipelines.export import export_command

    with errors_told(talk):
        options = export_command.ExportOptions(dataset_format, out, times, level, splats, device)
        with _stopped_told(talk, "export"):
            export_command.export(
                talk, job.run_dir, options, job.config.name,
                lambda until: said_of_stale(stale_stages(job, until)),
            )  # fmt: skip


@contextmanager
def _stopped_told(talk: Talk, what: str) -> Iterator[None]:
    """Ctrl-C or SIGTERM, in words."""
    try:
        with stopped_by_signals():
            yield
    except KeyboardInterrupt:
        text = f"stopped; nothing is left of this {what}, an earlier one stands; the same command begins anew"
        talk.error(text, "stopped")
        raise typer.Exit(STOPPED) from None


def _report_beside(talk: Talk, job: Run, scene: Path, page: Path) -> None:
    """Write the page as a file of the user's choice."""
    from devrf.pipelines.report.templates import MADE_BY
    from devrf.pipelines.stages.report import write_report

    with errors_told(talk):
        check_file(page, "--out", (MADE_BY,))
        if not any((job.run_dir / stage.name).is_dir() for stage in STAGES):
            raise _nothing_run(job, scene)
        with disk_told(page, "make room there"):
            page.parent.mkdir(parents=True, exist_ok=True)
            write_report(job.config, job.run_dir, page, stale_stages(job, "render"))
    talk.say(f"  report: {page}")


def _nothing_run(job: Run, scene: Path) -> InputError:
    remedy = f"run the scene first (devrf-pipeline run {scene})"
    return InputError("run-missing", f"{job.run_dir}: nothing has been run yet; {remedy}")


def _report_is_left(run_dir: Path) -> bool:
    """Whether a run that this user may only read has a report.

    Raises:
        InputError: It may only be read, and has none.
    """
    folder = run_dir / "report"
    if not run_dir.is_dir() or os.access(folder if folder.is_dir() else run_dir, os.W_OK):
        return False
    if not (folder / "index.html").is_file():
        wrong = f"{run_dir}: may not be written by this user, and holds no report"
        raise InputError(
            "folder-unwritable", f"{wrong}; name a file for it (--out page.html), or copy the run folder"
        )
    return True
