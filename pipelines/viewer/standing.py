"""What the viewer says about a run: what it shows, how far the run is, how healthy it is, facts of the model."""

import html
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from devrf.capture.scene import Scene
from devrf.pipelines.config.scene import SceneConfig
from devrf.pipelines.console import describe
from devrf.pipelines.health.rows import HealthRow
from devrf.pipelines.runner.lock import is_held
from devrf.pipelines.runner.plan import last_error, read_health
from devrf.pipelines.stages import STAGES
from devrf.pipelines.trained_model import model_files
from devrf.pipelines.viewer.source import Loaded, progress

if TYPE_CHECKING:  # it needs torch
    from devrf.reconstruct.model import DynamicModel

MOST_ROWS = 6  # of health: more are in the report
COLOURS = {
    "ok": "#1a7f4b",
    "warn": "#9a6200",
    "fail": "#b3261e",
    "running": "#2563b8",
}  # white is read on each
PILL = "color:#fff;border-radius:0.6em;padding:0.05em 0.5em;white-space:nowrap;"
FRAME = "font-size:0.85em;padding:0 0.75em 0.5em"
LINE = "margin:0.35em 0;overflow-wrap:anywhere"


def standing(config: SceneConfig, run_dir: Path, loaded: Loaded, unreadable: str = "") -> str:
    """HTML: what is shown, whether the run is finished, and whether it is healthy.

    Args:
        config: Of the scene.
        run_dir: The run folder.
        loaded: What is shown.
        unreadable: Why what is newest cannot be shown; empty: it is.
    """
    applying = [stage.name for stage in STAGES if stage.applies(config) is None]
    missing = [name for name in applying if not (run_dir / name).is_dir()]
    working = is_held(run_dir)
    lines = [f"<b>{_text(config.name)}</b>: {_shown(loaded, working)}"]
    if unreadable:
        lines.append(_pill("fail", "not readable") + _text(unreadable))
    if working:
        event = progress(run_dir)
        share = f" {100 * event['fraction']:.0f} %" if "fraction" in event else ""
        detail = f": {event['text']}" if event.get("text") else ""
        lines.append(_pill("running", "run at work") + _text(f"{event.get('stage', '')}{share}{detail}"))
    elif missing:
        lines.append(_pill("warn", "not finished") + f"not made yet: {', '.join(missing)}")
    errors = {name: last_error(run_dir, name) for name in applying if not working}
    lines += [_pill("fail", f"{name} failed") + _text(error) for name, error in errors.items() if error]
    lines += _health(run_dir, applying, whole=not missing and not working)
    return (
        f'<div style="{FRAME}">' + "".join(f'<div style="{LINE}">{line}</div>' for line in lines) + "</div>"
    )


def facts(run_dir: Path, loaded: Loaded) -> str:
    """Markdown: a table of what the model and the scene are."""
    scene, model = loaded.scene, loaded.model
    rows = [] if scene is None else _of_scene(scene)
    rows += [] if model is None else _of_model(model)
    if loaded.found.finished:
        size = sum(path.stat().st_size for path in model_files(run_dir))
        rows.append(("files of the model", f"{size / 1e6:.1f} MB"))
    return "| | |\n|---|---|\n" + "\n".join(f"| {name} | {value} |" for name, value in rows)


def _shown(loaded: Loaded, working: bool) -> str:
    found = loaded.found
    doing = "in training" if working else "from a training that was interrupted"
    if loaded.model is None:
        awaited = "the scene" if found.scene is None else "the first state of a training"
        what = "nothing to show yet" if found.scene is None else "cameras and points, no model yet"
        return f"{what}; {'awaiting' if working else 'there is no run at work to make'} {awaited}"
    if found.rest_training is not None:
        return f"scene at rest, <b>{doing}</b>"
    if found.motion_training is not None:
        return f"motion, <b>{doing}</b>"
    return "finished model" if loaded.model.motion is not None else "finished model at rest"


def _health(run_dir: Path, applying: Sequence[str], *, whole: bool) -> list[str]:
    """The verdict, then the rows that are not well, the worst first."""
    rows = [(name, row) for name in applying for row in read_health(run_dir / name)]
    bad, doubtful = ([(n, r) for n, r in rows if r.verdict == verdict] for verdict in ("fail", "warn"))
    if bad:
        lines = [_pill("fail", "unhealthy") + f"{_count(bad, 'check')} refused the result"]
    elif doubtful:
        lines = [_pill("warn", "doubtful") + f"{_count(doubtful, 'warning')} in {len(rows)} checks"]
    else:
        lines = [_pill("ok", "healthy") + f"{len(rows)} checks"] if whole and rows else []
    worst = (bad + doubtful)[:MOST_ROWS]
    return lines + [f"<b>{name}</b>: {_text(describe(row))}" for name, row in worst]


def _count(rows: Sequence[tuple[str, HealthRow]], what: str) -> str:
    return f"{len(rows)} {what}{'s' if len(rows) != 1 else ''}"


def _of_scene(scene: Scene) -> list[tuple[str, str]]:
    moving = {f.camera_name: f.split for f in scene.dynamic}
    tests = sum(split == "test" for split in moving.values())
    rows = [
        ("sweep", f"{len(scene.static)} pictures"),
        (
            "moving cameras",
            f"{len(moving) - tests}, and {tests} only for tests" if tests else f"{len(moving)}",
        ),
    ]
    if scene.dynamic:
        rows.append(("time", f"{scene.t0_s:.2f} to {scene.t1_s:.2f} s"))
    return rows


def _of_model(model: "DynamicModel") -> list[tuple[str, str]]:
    x, y, z = model.rest.canonical.shape
    rows = [("voxels at rest", f"{x} × {y} × {z}")]
    if model.motion is not None:
        t, a, b, c = model.motion.backward.shape[:4]
        rows.append(("motion", f"{a} × {b} × {c} at {t} times"))
    shell = model.rest.shell
    rows.append(("surroundings", model.rest.background if shell is None else f"{shell.size}³"))
    rows.append(("device", str(model.rest.canonical.density.device)))
    return rows


def _pill(kind: str, words: str) -> str:
    return f'<span style="{PILL}background:{COLOURS[kind]}">{words}</span> '


def _text(value: object) -> str:
    """Text in HTML, nothing of it markup."""
    return html.escape(str(value))
