"""Stage `report`: one self-contained HTML page about all that the other stages left."""

from collections.abc import Mapping
from pathlib import Path

from devrf.capture.measure import Measure
from devrf.capture.system.durable import whole
from devrf.pipelines.config.scene import SceneConfig
from devrf.pipelines.report.report_page import build_report
from devrf.pipelines.report.run_reader import RunFolder
from devrf.pipelines.run_folder.outcomes import last_error
from devrf.pipelines.stage import StageContext
from devrf.pipelines.stages import STAGES

PAGE = "index.html"
KINDS = {
    "sweep": "a scene at rest",
    "cameras": "moving cameras without a sweep",
    "dynamic": "a scene in motion",
    "dataset": "a finished data set",
}


def run(context: StageContext) -> None:
    """Write `index.html`."""
    unreadable = write_report(context.config, context.run_dir, context.out / PAGE)
    context.progress(1.0, PAGE)
    if unreadable:
        context.measures.append(Measure("report-unread", ", ".join(unreadable)))


def report_so_far(config: SceneConfig, run_dir: Path, stale: Mapping[str, str]) -> None:
    """Write the page about a run that is unfinished or stale; it carries no stamp, so the next run makes it again.

    Args:
        config: The scene.
        run_dir: Its run folder.
        stale: Why stages would be made again, by their names.
    """
    folder = run_dir / "report"
    folder.mkdir(exist_ok=True)
    (folder / "stamp.json").unlink(missing_ok=True)
    write_report(config, run_dir, folder / PAGE, stale)


def write_report(
    config: SceneConfig, run_dir: Path, path: Path, stale: Mapping[str, str] | None = None
) -> dict[str, str]:
    """Write the page about `run_dir`, at whatever state it is, as the file `path`.

    Returns:
        Files that are there but could not be read, with the reason.
    """
    reasons = {stage.name: why for stage in STAGES if (why := stage.applies(config)) is not None}
    names = [stage.name for stage in STAGES]
    others = [name for name in names if name != "report"]
    errors = {name: error for name in others if (error := last_error(run_dir, name)) is not None}
    run_folder = RunFolder(run_dir, names, reasons, errors, stale or {})
    facts = [KINDS[config.kind], f"preset {config.preset}"]
    page = build_report(run_folder, config.name, facts)
    with whole(path) as new:
        new.write_text(page, encoding="utf-8")
    return run_folder.unreadable
