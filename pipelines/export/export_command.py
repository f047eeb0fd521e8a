"""`devrf-pipeline export`: what has to be right before anything is written, and what is said in the end."""

import importlib.util
from collections.abc import Callable, Sequence
from pathlib import Path

from devrf.capture.system.errors import InputError
from devrf.pipelines.config.words import unknown_word
from devrf.pipelines.export.formats import FORMATS
from devrf.pipelines.export.request import ExportOptions, Format, Request
from devrf.pipelines.run_folder.outcomes import check_made, refusals
from devrf.pipelines.run_folder.output_folder import output_folder
from devrf.pipelines.stages import up_to
from devrf.pipelines.terminal.console import Talk

INSTALL = "python -m pip install 'devrf[export]'; in a clone: python -m pip install -e '.[export]'"


def export(
    talk: Talk,
    run_dir: Path,
    options: ExportOptions,
    title: str = "",
    stale: Callable[[str], Sequence[str]] = lambda stage: (),
) -> Path:
    """Write what a run has made in another program's files, and say where it is.

    Args:
        talk: Where to speak.
        run_dir: The run folder.
        options: What is asked for.
        title: Name of the scene.
        stale: What is to be said of stages up to one that have changed since they were made.
    Raises:
        InputError: An unknown format, an option it does not take, a library that is missing, a folder in use, nothing
            to export yet, or a link in the run folder.
        DevrfError: The format cannot hold this scene, a picture is missing, or nothing can be written.
    """
    name = options.format
    if name not in FORMATS:
        raise unknown_word("--format", name, tuple(FORMATS))
    chosen = FORMATS[name]
    folder = output_folder(run_dir, options.out, f"export/{name}", name)
    _check(chosen, options)
    check_made(run_dir, ("scene", "canonical") if chosen.stage == "canonical" else (chosen.stage,))
    # the model moves where that stage has run, and so do clocks
    last = "deformation" if chosen.stage in ("canonical", "scene") else chosen.stage
    notes = [*refusals(run_dir, up_to(last)), *stale(last)]
    request = Request(talk, run_dir, folder, options, title or run_dir.name, notes)
    chosen.write(request)
    for text in request.notes:
        talk.say(f"  note: {text}")
    talk.say(f"  {chosen.what} ({name}): {folder}")
    return folder


def _check(chosen: Format, options: ExportOptions) -> None:
    """Raises InputError where the format takes no such option, or lacks a library."""
    for option in options.given():
        if option not in chosen.options:
            takers = [n for n, other in FORMATS.items() if option in other.options]
            text = (
                f"--{option}: not for --format {options.format}; leave it out (taken by {', '.join(takers)})"
            )
            raise InputError("option-misplaced", text)
    missing = [module for module in chosen.modules if importlib.util.find_spec(module) is None]
    if missing:
        raise InputError(
            "package-missing",
            f"--format {options.format}: needs {', '.join(missing)}, which is not installed; install the extra "
            f"`export` ({INSTALL})",
        )
