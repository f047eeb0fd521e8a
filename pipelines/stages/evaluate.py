"""Stage `evaluate`: the model against pictures it was never trained on, and against the truth where known."""

import platform
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from devrf.calibration.clocks.equations import Clock
from devrf.calibration.truth import Truth, compare_cameras, compare_clocks, read_masks, read_truth
from devrf.capture.measure import Measure
from devrf.capture.scene import Scene
from devrf.capture.system.durable import read_object, write_json
from devrf.pipelines.config.scene import SceneConfig
from devrf.pipelines.health.left_out import NO_PICTURE
from devrf.pipelines.run_folder.clocks import clocks_in_use
from devrf.pipelines.run_folder.trained_model import trained_scene
from devrf.pipelines.stage import StageContext
from devrf.reconstruct import recipe
from devrf.reconstruct.evaluation.confidence import subject_seen
from devrf.reconstruct.evaluation.evaluate import NO_TEST_CAMERA, Known, LpipsNets, motion_psnr
from devrf.reconstruct.rendering.model import render_view
from devrf.reconstruct.storage.model_io import load_model

PACKAGES = ("devrf", "numpy", "torch", "warp-lang", "opencv-contrib-python-headless", "pycolmap")
TRAINED = ("canonical", "deformation")  # stages that hold models, which are what a viewer needs
TEST_VIEWS = "test views"  # what some measures are about
USUAL_ERRORS = {
    "rig_rotation_deg": 0.15,
    "rig_position_percent": 0.4,
    "sync_ms": 1.0,
}  # of a simulated session
NEEDS_TEST_VIEWS = (
    TEST_VIEWS,
    *USUAL_ERRORS,
)  # what measures are about that nobody has without a test camera


def run(context: StageContext) -> None:
    """Write `metrics.json` and `views/`."""
    config = context.config
    scene = trained_scene(context.run_dir)  # clocks of test cameras are as they were calibrated
    lpips = lpips_nets(config, context.scene_dir, context.device)
    model = load_model(context.run_dir, context.device)
    truth_file = config.truth_path(context.scene_dir)
    masks = {} if truth_file is None else true_masks(truth_file, scene)
    plain = model.unshaded()
    clocks = read_object(context.run_dir / "deformation" / "metrics.json").get("test_clocks", {})
    unshaded = None if plain is None else partial(render_view, plain)
    known = Known(masks, unshaded, clocks, why_no_test_views(config, context.run_dir))
    render = partial(render_view, model)
    metrics = recipe.evaluation(scene, render, lpips, context.out, context.progress, known)
    models = [path for stage in TRAINED for path in (context.run_dir / stage).glob("*.safetensors")]
    metrics |= {
        "true_masks": sorted(masks),
        "confidence": subject_seen(scene, model),
        "train": training(context.run_dir),
        "model_mb": round(sum(path.stat().st_size for path in models) / 1e6, 3),
        "versions": versions(),
        "seed": config.reconstruct.seed,
    }
    if truth_file is not None:
        metrics["truth"] = compare(read_truth(truth_file), scene, context.run_dir)
    context.measures += health(metrics, scene)
    write_json(context.out / "metrics.json", metrics)


def why_no_test_views(config: SceneConfig, run_dir: Path) -> str:
    """Why a test camera that scene.yaml names could not be measured with; without one, what to do."""
    names = config.capture.test_names if config.capture is not None else ()
    why: dict[str, str] = {}
    for file in ("ingest/ingest.json", "rig/rig.json"):
        why |= read_object(run_dir / file).get("left_out", {})
    told = [f"test camera {name}: {why.get(name, NO_PICTURE)}" for name in names]
    return "; ".join(told) or NO_TEST_CAMERA


def lpips_nets(config: SceneConfig, scene_dir: Path, device: str) -> LpipsNets:
    """The networks for LPIPS that scene.yaml names."""
    weights = config.evaluate.lpips_weights
    source = config.path(scene_dir, weights) if weights and weights != "download" else weights
    return LpipsNets.load(source or None, device)


def true_masks(truth_file: Path, scene: Scene) -> dict[str, np.ndarray]:
    """What moves in truth in test pictures, where masks lie beside the truth."""
    pictures: dict[str, tuple[int, int, int]] = {}
    for frame in (frame for frame in scene.dynamic if frame.split == "test"):
        before = pictures.get(frame.camera_name, (0, 0, 0))[0]
        size = frame.camera.height, frame.camera.width
        pictures[frame.camera_name] = max(before, frame.index + 1), *size
    return read_masks(truth_file, pictures)


def compare(truth: Truth, scene: Scene, run_dir: Path) -> dict[str, Any]:
    """The `truth` block: recovered cameras and clocks, as training moved them, against the true ones."""
    centre = np.linalg.inv(scene.box_from_world)[:3, 3]
    cameras = compare_cameras(
        truth,
        {frame.index: frame.camera for frame in scene.static},
        {frame.camera_name: frame.camera for frame in scene.dynamic},
        centre,
    )
    ingest = read_object(run_dir / "ingest" / "ingest.json").get("cameras", {})
    clocks = _clocks_trained_with(run_dir)
    times = {name: [f["time_s"] for f in c["frames"]] for name, c in ingest.items() if name in clocks}
    errors = compare_clocks(truth, clocks, {name: (t[0], t[-1]) for name, t in times.items() if t})
    return {
        **cameras,
        "sync_ms": max(errors.values()) if errors else None,
        "sync_ms_median": float(np.median(list(errors.values()))) if errors else None,
    }


def _clocks_trained_with(run_dir: Path) -> dict[str, Clock]:
    """The clocks that gave the scene its times, with what training moved; on the first camera's, as that was moved."""
    clocks = clocks_in_use(run_dir)
    moved_s = read_object(run_dir / "deformation" / "metrics.json").get("clock_offsets_s", {})
    zero_s = moved_s.get(next(iter(clocks), ""), 0.0)
    return {
        name: replace(clock, offset_s=clock.offset_s + moved_s.get(name, 0.0) - zero_s)
        for name, clock in clocks.items()
    }


def training(run_dir: Path) -> dict[str, Any]:
    """What both training stages took, from their metrics.json."""
    stages = {name: read_object(run_dir / name / "metrics.json") for name in TRAINED}
    seconds = {f"{name}_s": stage.get("seconds") for name, stage in stages.items()}
    iterations = sum(stage.get("iterations") or 0 for stage in stages.values())
    total = sum(value or 0.0 for value in seconds.values())
    rays = sum(stage.get("rays") or 0 for stage in stages.values())
    return {
        **seconds,
        "total_s": total,
        "iterations": iterations,
        "rays_per_s": rays / total if total else None,
        "peak_gpu_gb": max((s.get("peak_gpu_gb") or 0.0 for s in stages.values()), default=0.0) or None,
        "peak_rss_gb": max((s.get("peak_rss_gb") or 0.0 for s in stages.values()), default=0.0) or None,
        "device": stages["canonical"].get("device"),
    }


def versions() -> dict[str, str]:
    """Of Python and of the packages that the numbers depend on."""
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def health(metrics: dict[str, Any], scene: Scene) -> Iterator[Measure]:
    """Is the result any good, does motion earn its keep, and do cameras see enough of the subject?"""
    if any(frame.split == "test" for frame in scene.static):
        yield Measure("views-psnr", metrics["test_static"]["psnr"], "held-out sweep")
    if any(frame.split == "test" for frame in scene.dynamic):
        moving, still = motion_psnr(metrics)
        gain = None if moving is None or still is None else moving - still
        yield Measure("views-psnr", metrics["test"]["psnr"], TEST_VIEWS, "test", refuses=False)
        yield Measure("views-gain", gain, TEST_VIEWS, facts={"retimed": _said_retimed(metrics)})
    for name, warn in USUAL_ERRORS.items() if "truth" in metrics else ():
        if metrics["truth"][name] is not None:
            yield Measure("truth-missed", metrics["truth"][name], name, warn=warn)
    yield from surface_seen(metrics["confidence"])


def surface_seen(confidence: dict[str, Any]) -> Iterator[Measure]:
    """A box that shows nothing, or how much of the subject's motion nobody filmed."""
    if not confidence["seen_by"]:
        yield Measure("surface-unseen", "no surface is seen in the box", why="nothing")
    elif confidence["unseen_share"] is not None:
        yield Measure("surface-unseen", 100 * confidence["unseen_share"])


def _said_retimed(metrics: dict[str, Any]) -> str:
    """What motion gains with the clock that was found of a test camera whose own is not known."""
    retimed = metrics.get("test_moving_retimed", {"psnr": None})
    if retimed["psnr"] is None:
        return ""
    gain = retimed["psnr"] - metrics["static_baseline"]["test_moving_retimed"]["psnr"]
    offsets = [f"{name} {ms:+.0f} ms" for name, ms in retimed["offsets_ms"].items() if ms is not None]
    return f" A test camera's clock is not known: with {', '.join(offsets)} it gains {gain:.1f} dB."
