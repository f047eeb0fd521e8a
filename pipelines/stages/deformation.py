"""Stage `deformation`: how the scene moves, learned from the moving cameras."""

import json
from dataclasses import asdict, replace
from functools import partial

from devrf.calibration.clocks.geometry import carried_along
from devrf.capture.formats.scene_files import read_scene
from devrf.flow.store import read_flows
from devrf.pipelines.clocks_in_use import sharp_pairs
from devrf.pipelines.flow_clips import flow_estimator
from devrf.pipelines.health.in_motion import in_motion_rows
from devrf.pipelines.health.rows import HealthRow, row
from devrf.pipelines.health.training import flow_rows, moved_clock_rows, mover_rows, restart_rows
from devrf.pipelines.stage import StageContext
from devrf.pipelines.training_checkpoint import training_checkpoint
from devrf.pipelines.training_memory import TrainingMemory, fit_to_memory
from devrf.pipelines.training_options import training_options
from devrf.reconstruct.as_trained import as_trained
from devrf.reconstruct.check_motion import check_motion
from devrf.reconstruct.model_io import FILE, load_rest, save_deformation
from devrf.reconstruct.sizing import levels_for
from devrf.reconstruct.train_deformation import train_deformation

OFTEN_LEFT, MOSTLY_LEFT = 0.05, 0.5  # share of samples whose motion leads out of the box


def run(context: StageContext) -> None:
    """Write models and `metrics.json`; a training that was killed goes on from its checkpoint."""
    scene = read_scene(context.run_dir / "scene")
    memory = TrainingMemory.now(context)
    rest = load_rest(context.run_dir / "canonical" / FILE, context.device)
    asked = training_options(context.config, scene).motion
    asked = levels_for(asked, rest.canonical) if asked.adapt else asked
    # there may be fewer voxels than planned
    asked = replace(asked, resolution=round(rest.canonical.resolution))
    checkpoint = training_checkpoint(context, "deformation", asked)
    options, fits = fit_to_memory(context, scene, asked, memory, checkpoint)
    flows = read_flows(context.run_dir / "flow")
    model, metrics = train_deformation(
        scene,
        rest,
        flows,
        options,
        context.device,
        context.progress,
        checkpoint,
        estimator=partial(flow_estimator, context.config, context.scene_dir, context.device),
    )
    save_deformation(context.out, model)
    if metrics.get("clock_offsets_s"):
        training = {frame.camera_name for frame in scene.dynamic if frame.split == "train"}
        moved_s = metrics["clock_offsets_s"]
        metrics["clock_offsets_s"] = moved_s | carried_along(moved_s, training, sharp_pairs(context.run_dir))
    for line in metrics["decisions"]:
        context.say(f"  {line}")
    cameras = check_motion(as_trained(scene, metrics), model, options.seed)
    metrics |= {
        "decisions": fits + metrics["decisions"],
        "options": asdict(options),
        "check": {name: asdict(fit) for name, fit in cameras.items()},
    }
    (context.out / "metrics.json").write_text(json.dumps(metrics, indent=1, allow_nan=False) + "\n")
    if "left_box_share" in metrics:  # movers go wherever they were tracked
        context.health.append(_left_box(metrics["left_box_share"]))
    context.health.extend(in_motion_rows(cameras))
    context.health.extend(restart_rows(metrics))
    context.health.extend(mover_rows(metrics))
    context.health.extend(flow_rows(metrics["flow_contradicted"]))
    context.health.extend(moved_clock_rows(metrics.get("clock_offsets_s", {})))


def _left_box(share: float) -> HealthRow:
    return row(
        "samples whose motion leads out of the box",
        100 * share,
        "%",
        warn_above=100 * OFTEN_LEFT,
        fail_above=100 * MOSTLY_LEFT,
        remedy="The subject moves out of the box around the scene at rest: keep it nearer to where it "
        "rests, or let the fixed cameras see all of its way so that the box is made larger.",
    )
