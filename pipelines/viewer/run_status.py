"""What the viewer says about a run: what it shows, how far the run is, how healthy it is."""

from collections.abc import Mapping
from html import escape
from pathlib import Path

from devrf.pipelines.config.scene import SceneConfig
from devrf.pipelines.run_folder.lock import is_held
from devrf.pipelines.run_folder.outcomes import last_error, read_health
from devrf.pipelines.stages import STAGES
from devrf.pipelines.terminal.console import describe
from devrf.pipelines.viewer.source import Loaded, progress

MOST_ROWS = 3  # of health: more, and warnings, are in the report
OK, WARN, FAIL, RUNNING = "#1a7f4b", "#9a6200", "#b3261e", "#2563b8"  # white is read on each
LINE = '<div style="font-size:0.85em;margin:0.35em 0.75em;overflow-wrap:anywhere">{}</div>'
PILL = '<span style="color:#fff;border-radius:0.6em;padding:0.05em 0.5em;background:{}">{}</span> '


def standing(
    config: SceneConfig, run_dir: Path, loaded: Loaded, wrong: Mapping[str, str] | None = None
) -> str:
    """HTML: what is shown, whether the run is finished, and whether it is healthy.

    Args:
        config: Of the scene.
        run_dir: The run folder.
        loaded: What is shown.
        wrong: What is amiss with the viewer's own picture of it: name and reason; empty reasons are none.
    """
    applying = [stage.name for stage in STAGES if stage.applies(config) is None]
    missing = [name for name in applying if not (run_dir / name).is_dir()]
    working = is_held(run_dir)
    lines = [f"<b>{escape(config.name)}</b>: {_shown(loaded, working)}"]
    lines += [PILL.format(FAIL, what) + escape(why) for what, why in (wrong or {}).items() if why]
    if working:
        event = progress(run_dir)
        share = f" {100 * event['fraction']:.0f} %" if "fraction" in event else ""
        detail = f": {event['text']}" if event.get("text") else ""
        lines.append(PILL.format(RUNNING, "run at work") + escape(f"{event.get('stage', '')}{share}{detail}"))
    elif missing:
        lines.append(PILL.format(WARN, "not finished") + f"not made yet: {', '.join(missing)}")
    for name in () if working else applying:
        error = last_error(run_dir, name)
        lines += [PILL.format(FAIL, f"{name} failed") + escape(error)] if error else []
    rows = [(name, row) for name in applying for row in read_health(run_dir / name)]
    bad, doubtful = ([(n, r) for n, r in rows if r.verdict == verdict] for verdict in ("fail", "warn"))
    if bad:
        lines.append(PILL.format(FAIL, "unhealthy") + f"checks that refused the result: {len(bad)}")
    elif doubtful:
        lines.append(PILL.format(WARN, "doubtful") + f"warnings: {len(doubtful)} in {len(rows)} checks")
    elif rows and not missing and not working:
        lines.append(PILL.format(OK, "healthy") + f"{len(rows)} checks")
    lines += [f"<b>{name}</b>: {escape(describe(row))}" for name, row in bad[:MOST_ROWS]]
    return "".join(LINE.format(line) for line in lines)


def _shown(loaded: Loaded, working: bool) -> str:
    found = loaded.found
    if loaded.model is None:
        awaited = "the scene" if found.scene is None else "the first state of a training"
        what = "nothing to show yet" if found.scene is None else "cameras and points, no model yet"
        return f"{what}; {'awaiting' if working else 'there is no run at work to make'} {awaited}"
    if found.training is not None:
        what = "scene at rest" if found.training[0] == "canonical" else "motion"
        return f"{what}, <b>{'in training' if working else 'from a training that was interrupted'}</b>"
    return "finished model" if loaded.model.motion is not None else "finished model at rest"
