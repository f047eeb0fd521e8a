"""The command line, `devrf-pipeline`. Heavy libraries are imported only by the commands that need them."""

import errno
import json
import os
import sys
from pathlib import Path
from typing import Annotated

import typer

import devrf
from devrf.capture.system.writable import check_file, check_folder
from devrf.pipelines.cli import run_command
from devrf.pipelines.cli.installed import add_installed
from devrf.pipelines.cli.results import compare, export, render, report, view
from devrf.pipelines.cli.status import print_status, status_dict
from devrf.pipelines.runner.run_state import dry_run
from devrf.pipelines.runner.standing import Choice
from devrf.pipelines.runner.supervise import supervised
from devrf.pipelines.stages import stage_names
from devrf.pipelines.terminal.console import Talk
from devrf.pipelines.terminal.disk_errors import disk_told, refused_by_system
from devrf.pipelines.terminal.exit_codes import BAD_INPUT, DONE, FAILED, STOPPED, UNHEALTHY
from devrf.pipelines.terminal.shared_options import (
    AllowUnhealthyOption,
    Command,
    DeviceOption,
    PresetOption,
    QuietOption,
    SceneArgument,
    SetOption,
    UntilOption,
    VerboseOption,
    errors_told,
    talk_of,
)
from devrf.pipelines.terminal.streams import all_was_said, open_streams

app = typer.Typer(
    help="From a field capture of a moving scene to novel views of it.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

STAGE_HELP = f"one of {', '.join(stage_names())}"


@app.command(cls=Command)
def init(
    folder: Annotated[Path, typer.Argument(help="Folder with the raw files")],
    name: Annotated[str | None, typer.Option(help="Name of the scene; default: the folder's")] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace a scene.yaml that is there")] = False,
    quiet: QuietOption = False,
) -> None:
    """Look at a folder of raw files and write a commented scene.yaml."""
    talk = talk_of(quiet)
    from devrf.pipelines.init import init_command

    with errors_told(talk), disk_told(folder, "make room, or copy it to another disk"):
        init_command.init(talk, folder, name, force)


@app.command(cls=Command)
def check(
    scene: SceneArgument,
    preset: PresetOption = None,
    overrides: SetOption = None,
    as_json: Annotated[Path | None, typer.Option("--json", help="File for the rows")] = None,
    quiet: QuietOption = False,
    verbose: VerboseOption = False,
) -> None:
    """Look at a few pictures of every clip before the crew goes home: go or no-go."""
    talk = talk_of(quiet, verbose)
    job = run_command.prepare(talk, scene, preset, overrides, None)
    with errors_told(talk):
        check_folder(job.run_dir, "output:")
        from devrf.pipelines.check import check_command

        if as_json is not None:
            check_file(as_json, "--json", check_command.IN_JSON)
        from devrf.pipelines.stages.preflight import check_inputs

        check_inputs(job.config, job.scene_dir, {"ingest", "scene"})

        go = check_command.check(job, as_json)
    raise typer.Exit(DONE if go else UNHEALTHY)


@app.command(cls=Command)
def run(
    scene: SceneArgument,
    preset: PresetOption = None,
    first: Annotated[str | None, typer.Option("--from", help=f"Start here: {STAGE_HELP}")] = None,
    until: UntilOption = None,
    force: Annotated[
        list[str] | None, typer.Option(help="Run this stage even if nothing changed; all for every stage")
    ] = None,
    overrides: SetOption = None,
    device: DeviceOption = "auto",
    dry: Annotated[bool, typer.Option("--dry-run", help="Say what would run, and why")] = False,
    allow_unhealthy: AllowUnhealthyOption = False,
    quiet: QuietOption = False,
    verbose: VerboseOption = False,
) -> None:
    """Run the stages of a scene; resume where the last run stopped."""
    talk = talk_of(quiet, verbose)
    choice = Choice(first, until, tuple(force or ()), allow_unhealthy)
    job = run_command.prepare(talk, scene, preset, overrides, choice)
    with errors_told(talk):
        found = job.standings()
        if dry:
            dry_run(job, found)
        run_command.check(job, found, device)
    if not dry:
        run_command.carry_out(job)


@app.command(cls=Command)
def demo(
    folder: Annotated[Path, typer.Argument(help="Folder for the example and its run")] = Path("devrf-demo"),
    until: UntilOption = None,
    device: DeviceOption = "auto",
    quiet: QuietOption = False,
    verbose: VerboseOption = False,
) -> None:
    """Run the example session, which comes with the program: no camera and no GPU needed, some minutes."""
    talk = talk_of(quiet, verbose)
    from devrf.pipelines.cli.demo import lay_out

    with errors_told(talk):
        scene = lay_out(talk, folder)
    job = run_command.prepare(talk, scene, None, None, Choice(last=until))
    with errors_told(talk):
        run_command.check(job, job.standings(), device)
    run_command.carry_out(job)


@app.command(cls=Command)
def batch(
    scenes: Annotated[list[Path], typer.Argument(help="scene.yaml files, or the folders that hold them")],
    engine: Annotated[
        str,
        typer.Option(
            help="local: this machine; ray: a Ray cluster, whose machines share a disk (extra `ray`)"
        ),
    ] = "local",
    address: Annotated[
        str | None,
        typer.Option(
            help="ray: HOST:PORT of the cluster, or auto; default: a private cluster on this machine"
        ),
    ] = None,
    jobs: Annotated[
        int | None, typer.Option(min=1, help="Scenes at once; default: one per GPU, else by cores and memory")
    ] = None,
    preset: PresetOption = None,
    until: Annotated[str | None, typer.Option(help="Stop every scene after this stage")] = None,
    overrides: SetOption = None,
    device: DeviceOption = "auto",
    allow_unhealthy: AllowUnhealthyOption = False,
    out: Annotated[Path, typer.Option(help="Folder of the summary, batch.json")] = Path("batch"),
    quiet: QuietOption = False,
    verbose: VerboseOption = False,
) -> None:
    """Run many scenes side by side; one that fails stops no other, and a second call does only what is missing."""
    talk = talk_of(quiet, verbose)
    from devrf.pipelines.batch import batch_command as command

    options = command.BatchOptions(
        preset, tuple(overrides or ()), until, allow_unhealthy, engine, address, jobs, device, out
    )
    with errors_told(talk):
        code = command.batch(talk, scenes, options)
    raise typer.Exit(code)


@app.command(cls=Command)
def status(
    scene: SceneArgument,
    preset: PresetOption = None,
    overrides: SetOption = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON")] = False,
) -> None:
    """Show each stage: fresh, stale (and why) or missing, its time, its health."""
    talk = Talk()
    job = run_command.prepare(talk, scene, preset, overrides, None, check_files=False)
    with errors_told(talk):
        found = job.standings()
    job.digests.save()
    if as_json:
        typer.echo(json.dumps(status_dict(job.config, job.run_dir, found), indent=1))
    else:
        print_status(talk.out, job.config, job.run_dir, found)


for results_command in (report, compare, view, render, export):
    app.command(cls=Command)(results_command)


def _version(show: bool) -> bool:
    if show:
        typer.echo(f"devrf {devrf.__version__}")
        raise typer.Exit(DONE)
    return show


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version")
    ] = False,
) -> None:
    pass


add_installed(app)

NO_PATH = (errno.ENAMETOOLONG, errno.EACCES, errno.EPERM, errno.ELOOP)  # a mistake in what was named


def main() -> None:
    """Entry point of the console script."""
    open_streams()
    supervised(_command)


def _command() -> None:
    try:
        app()
    except KeyboardInterrupt:
        sys.exit(STOPPED)
    except OSError as error:
        talk = Talk()
        if error.filename is not None and error.errno in NO_PATH:
            wrong = f"{os.fsdecode(error.filename)}: cannot be looked at ({error.strerror})"
            talk.error(
                f"{wrong}; name another path, or make it one that this user may enter", "path-unusable"
            )
            sys.exit(BAD_INPUT)
        refused = refused_by_system(error, Path.cwd())
        if refused is None:
            raise
        talk.error(str(refused), refused.code)
        sys.exit(FAILED)
    except SystemExit as end:
        if not all_was_said() and end.code in (DONE, None):
            sys.exit(FAILED)
        raise


if __name__ == "__main__":
    main()
