"""Commands that run stages: what has to be right before anything starts, and what is said in the end."""

from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

import typer

from devrf.capture.system.errors import InputError
from devrf.capture.system.writable import check_folder
from devrf.pipelines.inputs.device import resolve_device
from devrf.pipelines.run_folder.own_folder import check_run_folder
from devrf.pipelines.runner.execute import execute
from devrf.pipelines.runner.run_state import Run, check_choice, check_reads
from devrf.pipelines.runner.standing import Choice, Standing
from devrf.pipelines.stages import STAGES, stage_names
from devrf.pipelines.terminal.console import Talk
from devrf.pipelines.terminal.exit_codes import DONE
from devrf.pipelines.terminal.logs import last_scene
from devrf.pipelines.terminal.shared_options import configured, errors_told


def prepare(
    talk: Talk,
    scene: Path,
    preset: str | None,
    overrides: Sequence[str] | None,
    choice: Choice | None,
    *,
    check_files: bool = True,
) -> Run:
    """As `prepared`; ends the program with exit code 2 where the configuration is wrong."""
    with errors_told(talk):
        return prepared(talk, scene, preset, overrides, choice, check_files=check_files)


def prepared(
    talk: Talk,
    scene: Path,
    preset: str | None,
    overrides: Sequence[str] | None,
    choice: Choice | None,
    *,
    check_files: bool = True,
) -> Run:
    """Read and check the configuration.

    Without a choice nothing is going to run, and what could not be run is no mistake.

    Raises:
        InputError: With every mistake in it.
    """
    config, scene_dir = configured(scene, preset, overrides, check_files=check_files)
    job = Run(config, scene_dir, STAGES, choice or Choice(), talk)
    if choice is not None:
        _check_run(job)
    return job


def carry_out(job: Run) -> NoReturn:
    """Run what has been checked, say where to look, and end with the exit code."""
    code = execute(job)
    if code == DONE:
        say_where(job)
    raise typer.Exit(code)


def check(job: Run, found: Sequence[Standing], device: str) -> None:
    """Look at the device, the run folder and the raw files, where a stage is to run.

    Raises:
        DevrfError: Something stands against a run.
    """
    to_do = {now.stage.name for now in found if now.to_make and job.chosen(now.stage.name)}
    check_reads(job)
    if to_do:
        job.device = resolve_device(device, job.config.budget.gpu_memory_gb)
        check_folder(job.run_dir, "output:")
        from devrf.pipelines.stages.preflight import check_inputs

        check_inputs(job.config, job.scene_dir, to_do)


def only(job: Run, stage: str, scene: Path, device: str = "cpu") -> NoReturn:
    """Run one stage of a run that has been made before of a `scene`, and end with the exit code."""
    job.choice = Choice(first=stage, last=stage, force=(stage,), allow_unhealthy=True)
    with errors_told(job.talk):
        _check_run(job)
        check_reads(job, f"run the scene first (devrf-pipeline run {scene})")
        job.device = resolve_device(device, job.config.budget.gpu_memory_gb)
    carry_out(job)


def _check_run(job: Run) -> None:
    check_choice(job)
    check_run_folder(job.run_dir, stage_names())
    _check_owner(job)


def _check_owner(job: Run) -> None:
    """Refuse the folder that another scene's name has made, too; one that is named in scene.yaml is its owner's."""
    other = None if job.config.output is not None else last_scene(job.run_dir)
    if other is not None and other != job.config.name:
        wrong = f"output: {job.run_dir}: is the run folder of another scene, {other!r}, too"
        text = f"{wrong}; name another folder (output: in scene.yaml), or give the scene another name"
        raise InputError("folder-of-another", text)


def say_where(job: Run) -> None:
    """Name what people want to see, of the stages that are fresh now."""
    found = [
        ("report", "report", "index.html"),
        ("film", "render", "*.mp4"),
        ("numbers", "evaluate", "metrics.json"),
    ]
    for what, stage, pattern in found:
        if stage in job.fresh:
            for path in sorted((job.run_dir / stage).glob(pattern)):
                job.talk.say(f"  {what}: {path}")
