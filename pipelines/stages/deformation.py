"""Stage `deformation`: how the scene moves, learned from the moving cameras."""

from collections.abc import Mapping
from dataclasses import asdict, replace
from functools import partial
from typing import Any

from devrf.calibration.clocks.equations import Clock
from devrf.capture.formats.parts.scene_files import read_scene
from devrf.capture.measure import Measure
from devrf.capture.scene import Scene
from devrf.capture.system.durable import write_json
from devrf.flow.store import read_flows
from devrf.pipelines.budget.training_memory import TrainingMemory, fit_to_memory
from devrf.pipelines.health.training_rows import (
    contradicted_measures,
    in_motion_measures,
    moved_clock_measures,
    mover_measures,
    restart_measures,
)
from devrf.pipelines.inputs.flow_clips import flow_estimator
from devrf.pipelines.inputs.training_options import training_options
from devrf.pipelines.run_folder.clocks import SURE_S, clock_dict, clocks_in_use, sure_clocks
from devrf.pipelines.run_folder.training_checkpoint import training_checkpoint
from devrf.pipelines.stage import StageContext
from devrf.reconstruct import recipe
from devrf.reconstruct.adapt.sizing import levels_for
from devrf.reconstruct.evaluation.check_motion import check_motion
from devrf.reconstruct.rendering.model import DynamicModel
from devrf.reconstruct.sampling.retimed import as_trained
from devrf.reconstruct.storage.model_io import FILE, load_rest, save_deformation
from devrf.reconstruct.training.loop import TrainingRun
from devrf.reconstruct.training.own_motion import fit_own
from devrf.reconstruct.training.test_clocks import ViewOffset, view_offset

FIELD = "motion is a field: clocks are found on models of parts only"


def run(context: StageContext) -> None:
    """Write models and `metrics.json`; a training that was killed goes on from its checkpoint."""
    scene = replace(read_scene(context.run_dir / "scene"), sure_clocks=sure_clocks(context.run_dir))
    memory = TrainingMemory.now(context)
    rest = load_rest(context.run_dir / "canonical" / FILE, context.device)
    asked = training_options(context.config, scene).motion
    asked = levels_for(asked, rest.canonical) if asked.adapt else asked
    # there may be fewer voxels than planned
    asked = replace(asked, resolution=round(rest.canonical.resolution))
    checkpoint = training_checkpoint(context, "deformation", asked)
    options, fits = fit_to_memory(context, scene, asked, memory, checkpoint)
    flows = read_flows(context.run_dir / "flow")
    own = context.config.reconstruct.motion
    if own == "auto":
        estimator = partial(flow_estimator, context.config, context.scene_dir, context.device)
        training = TrainingRun(context.device, context.progress, checkpoint)
        model, metrics = recipe.motion(scene, rest, flows, options, training, estimator)
    else:
        model, metrics = fit_own(own, scene, rest, flows, options, context.progress)
    save_deformation(context.out, model)
    metrics["test_clocks"] = _test_clocks(context, scene, model, metrics)
    for line in metrics["decisions"]:
        context.say(f"  {line}")
    cameras = check_motion(as_trained(scene, metrics), model, options.seed)
    metrics |= {
        "decisions": fits + metrics["decisions"],
        "options": asdict(options),
        "check": {name: asdict(fit) for name, fit in cameras.items()},
    }
    write_json(context.out / "metrics.json", metrics)
    if "left_box_share" in metrics:  # movers go wherever they were tracked
        context.measures.append(Measure("motion-leaves-box", 100 * metrics["left_box_share"]))
    context.measures += in_motion_measures(cameras)
    context.measures += restart_measures(metrics)
    context.measures += mover_measures(metrics)
    context.measures += contradicted_measures(metrics["flow_contradicted"])
    context.measures += moved_clock_measures(metrics.get("clock_offsets_s", {}))
    of_tests = {name: clock["offset_s"] for name, clock in metrics["test_clocks"].items()}
    context.measures += moved_clock_measures(of_tests, "test")


def _test_clocks(
    context: StageContext, scene: Scene, model: DynamicModel, metrics: Mapping[str, Any]
) -> dict[str, dict[str, Any]]:
    """What the model says of clocks of test cameras that are not known well enough to measure by; none is moved."""
    trained = as_trained(scene, metrics).in_box_frame()
    clocks, out = clocks_in_use(context.run_dir), {}
    for name in unknown_test_clocks(trained, clocks):
        context.progress(0.99, f"clock of {name}")
        found = ViewOffset(None, FIELD)
        if model.movers is not None:
            estimator = flow_estimator(context.config, context.scene_dir, context.device)
            found = view_offset(trained, model, name, estimator)
        out[name] = {"std_s": clock_dict(clocks[name])["std_s"], **asdict(found)}
    return out


def unknown_test_clocks(scene: Scene, clocks: Mapping[str, Clock]) -> list[str]:
    """Cameras that are not trained on whose clocks are not good enough to measure by."""
    splits = {name: {f.split for f in scene.dynamic if f.camera_name == name} for name in clocks}
    unsure = {name for name, clock in clocks.items() if clock.std_s > SURE_S}
    return [name for name, of in splits.items() if of == {"test"} and name in unsure]
