"""`devrf-pipeline export`: what has to be right before anything is written, and what is said in the end."""

import importlib.util
from collections.abc import Callable, Sequence
from pathlib import Path

from devrf.capture.formats.parts.export import check_target
from devrf.capture.system.errors import InputError
from devrf.pipelines.config.gone import GONE
from devrf.pipelines.config.words import suggestion
from devrf.pipelines.export.formats import FORMATS
from devrf.pipelines.export.request import Format, Options, Request
from devrf.pipelines.run_folder.outcomes import read_health
from devrf.pipelines.run_folder.own_folder import check_run_folder
from devrf.pipelines.stages import STAGES
from devrf.pipelines.stamps.stamp import STAMP
from devrf.pipelines.terminal.console import Talk

INSTALL = "python -m pip install 'devrf[export]'; in a clone: python -m pip install -e '.[export]'"


def export(
    talk: Talk,
    run_dir: Path,
    name: str,
    out: Path | None,
    options: Options | None = None,
    title: str = "",
    stale: Callable[[str], Sequence[str]] = lambda stage: (),
) -> Path:
    """Write what a run has made in another program's files, and say where it is.

    Args:
        talk: Where to speak.
        run_dir: The run folder.
        name: One of `FORMATS`.
        out: Folder to write; None: `export/<format>` in the run folder.
        options: What some formats take.
        title: Name of the scene.
        stale: What is to be said of stages up to one that have changed since they were made.
    Raises:
        InputError: An unknown format, an option it does not take, a library that is missing, a folder in use, nothing
            to export yet, or a link in the run folder.
        DevrfError: The format cannot hold this scene, a picture is missing, or nothing can be written.
    """
    if name not in FORMATS:
        expected = f"expected {', '.join(FORMATS)}{suggestion(name, FORMATS)}"
        text = f"--format {name}: {GONE.get(f'--format {name}', expected)}"
        raise InputError("option-unknown-value", text)
    chosen, options = FORMATS[name], options or Options()
    if out is None:
        check_run_folder(run_dir, ())
    folder = run_dir / "export" / name if out is None else out.expanduser().resolve()
    _check(run_dir, name, chosen, options)
    check_target(folder, name)
    # the model moves where that stage has run, and so do clocks
    last = "deformation" if chosen.stage in ("canonical", "scene") else chosen.stage
    notes = [*_unhealthy(run_dir, last), *stale(last)]
    request = Request(talk, run_dir, name, folder, options, title or run_dir.name, notes)
    chosen.write(request)
    for text in request.notes:
        talk.say(f"  note: {text}")
    talk.say(f"  {chosen.what} ({name}): {folder}")
    return folder


def _check(run_dir: Path, name: str, chosen: Format, options: Options) -> None:
    """Raises InputError where the format takes no such option, lacks a library, or the run is not that far."""
    for option in options.given():
        if option not in chosen.options:
            takers = [n for n, other in FORMATS.items() if option in other.options]
            text = f"--{option}: not for --format {name}; leave it out (taken by {', '.join(takers)})"
            raise InputError("option-misplaced", text)
    missing = [module for module in chosen.modules if importlib.util.find_spec(module) is None]
    if missing:
        raise InputError(
            "package-missing",
            f"--format {name}: needs {', '.join(missing)}, which is not installed; install the extra `export` "
            f"({INSTALL})",
        )
    for stage in ("scene", "canonical") if chosen.stage == "canonical" else (chosen.stage,):
        if not (run_dir / stage / STAMP).is_file():
            what = "the model" if stage == "canonical" else f"the {stage}"
            text = f"{run_dir}: {what} has not been made yet; run with --until {chosen.stage} first"
            raise InputError("stage-not-made", text)


def _unhealthy(run_dir: Path, last: str) -> list[str]:
    """What the run's own checks refused, up to the last stage that is exported, in words."""
    names = [each.name for each in STAGES]
    rows = [(n, row) for n in names[: names.index(last) + 1] for row in read_health(run_dir / n)]
    return [
        f"the run is not healthy: {name}: {row.title}; {row.remedy}"
        for name, row in rows
        if row.verdict == "fail"
    ]
