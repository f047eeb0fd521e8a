"""Stage `canonical`: the scene at rest and its surroundings, learned from the sweep and from fixed cameras."""

from dataclasses import asdict
from typing import Any

from devrf.capture.formats.parts.scene_files import read_scene
from devrf.capture.measure import Measure
from devrf.capture.system.durable import write_json
from devrf.pipelines.budget.training_memory import TrainingMemory, fit_to_memory
from devrf.pipelines.health.at_rest_rows import at_rest_measures
from devrf.pipelines.health.training_rows import restart_measures
from devrf.pipelines.inputs.training_options import training_options
from devrf.pipelines.run_folder.training_checkpoint import training_checkpoint
from devrf.pipelines.stage import StageContext
from devrf.reconstruct import recipe
from devrf.reconstruct.evaluation.check_rest import check_rest
from devrf.reconstruct.storage.model_io import FILE, save_rest
from devrf.reconstruct.training.loop import TrainingRun


def run(context: StageContext) -> None:
    """Write `model.safetensors` and `metrics.json`; a training that was killed goes on from its checkpoint."""
    scene = read_scene(context.run_dir / "scene")
    asked = training_options(context.config, scene).canonical
    checkpoint = training_checkpoint(context, "canonical", asked)
    options, fits = fit_to_memory(context, scene, asked, TrainingMemory.now(context), checkpoint)
    model = recipe.canonical(scene, options, TrainingRun(context.device, context.progress, checkpoint))
    save_rest(context.out / FILE, model)
    for line in model.metrics["decisions"]:
        context.say(f"  {line}")
    decisions = fits + model.metrics["decisions"]
    found = check_rest(scene, model)
    fits_at_rest = {
        "cameras": {n: asdict(f) for n, f in found.cameras.items()},
        "sweep": [asdict(f) for f in found.sweep],
        "plates": {n: asdict(f) for n, f in found.plates.items()},
    }
    metrics: dict[str, Any] = model.metrics | {
        "decisions": decisions,
        "options": asdict(options),
        "check": fits_at_rest,
    }
    write_json(context.out / "metrics.json", metrics)
    context.measures.append(Measure("rest-psnr", metrics["train_psnr"]))
    context.measures += at_rest_measures(found)
    context.measures += restart_measures(metrics)
