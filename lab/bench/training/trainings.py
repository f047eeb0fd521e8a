"""Trainings that benchmarks compare: a scene made ready once, then models of it by options; each kept, none twice."""

import hashlib
import json
import os
import platform
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import typer

from devrf.capture.formats.parts.scene_files import read_scene
from devrf.capture.scene import Scene
from devrf.capture.system.errors import InputError
from devrf.capture.system.progress import Progress
from devrf.flow.store import CameraFlow, read_flows
from devrf.lab.bench.bench_rows import Row, publish
from devrf.lab.bench.training.progress_views import Looks
from devrf.pipelines.inputs.flow_clips import flow_estimator
from devrf.pipelines.inputs.training_options import training_options
from devrf.pipelines.runner.execute import execute
from devrf.pipelines.runner.run_state import Run
from devrf.pipelines.runner.standing import Choice
from devrf.pipelines.stages import STAGES
from devrf.pipelines.stages.evaluate import lpips_nets, versions
from devrf.pipelines.stamps.code_version import code_version
from devrf.pipelines.stamps.stamp import STAMP
from devrf.pipelines.terminal.exit_codes import DONE
from devrf.reconstruct import recipe
from devrf.reconstruct.evaluation.evaluate import METRICS, LpipsNets, Render, evaluate
from devrf.reconstruct.fields.canonical_model import RestModel
from devrf.reconstruct.options import CanonicalOptions, MotionOptions, TrainingOptions
from devrf.reconstruct.rendering.model import render_view
from devrf.reconstruct.storage.checkpoint import Checkpoint
from devrf.reconstruct.storage.model_io import load_deformation, load_rest, save_deformation, save_rest
from devrf.reconstruct.training.loop import TrainingRun

UNITS = {"psnr": "dB", "ssim": "", "lpips_vgg": "", "lpips_alex": ""}


@dataclass
class Bench:
    """A scene that is ready to be trained on.

    Attributes:
        run: The run that made it ready.
        out: Where the benchmark writes: a run folder with models of every seed beside the stages.
        scene: Calibrated.
        flows: Backward flow by camera.
    """

    run: Run
    out: Path
    scene: Scene
    flows: dict[str, CameraFlow]

    @staticmethod
    def prepare(run: Run, out: Path) -> "Bench":
        """Run the stages up to flow, in a folder of the benchmark's own; ends the program where they fail."""
        config = run.config.model_copy(update={"output": str(out.resolve())})
        ready = Run(config, run.scene_dir, STAGES, Choice(last="flow"), run.talk, run.device)
        code = execute(ready)
        if code != DONE:
            raise typer.Exit(code)
        return Bench.of_run(ready, out)

    @staticmethod
    def of_run(run: Run, out: Path) -> "Bench":
        """A run whose stages up to flow are made."""
        scene = read_scene(run.run_dir / "scene")
        if not {"train", "test"} <= {f.split for f in scene.dynamic}:
            raise InputError(
                "test-camera-missing",
                f"{run.config.name}: a benchmark needs moving cameras to train on and one to test with "
                "(capture.test_cameras, or the data set's test split)",
            )
        return Bench(run, out, scene, read_flows(run.run_dir / "flow"))

    @cached_property
    def lpips(self) -> LpipsNets:
        """The networks that scene.yaml names."""
        return lpips_nets(self.run.config, self.run.scene_dir, self.run.device)

    def options(self, preset: str | None = None, **changes: Any) -> TrainingOptions:
        """Of a preset (None: the configured one), with what scene.yaml overrides, and `reconstruct` keys changed."""
        config = self.run.config
        reconstruct = config.reconstruct.model_copy(update=changes)
        update = {"preset": preset or config.preset, "reconstruct": reconstruct}
        return training_options(config.model_copy(update=update), self.scene)

    def rest(self, options: CanonicalOptions, looks: Looks | None = None) -> RestModel:
        """The scene at rest, trained or read again; with `looks`, `metrics["looks"]` says how it got there."""
        file = self._rest_file(options.seed)

        def train(checkpoint: Checkpoint, progress: Progress) -> dict[str, Any]:
            watch = looks.of_rest() if looks is not None else None
            model = recipe.canonical(
                self.scene, options, TrainingRun(self.run.device, progress, checkpoint, watch)
            )
            save_rest(file, model)
            return model.metrics | ({"looks": looks.taken()} if looks is not None else {})

        metrics = self.once(options.seed, "rest", self.fingerprint(options), train)
        # Always as read from the file: the same whether it was trained now or before.
        return replace(load_rest(file, self.run.device), metrics=metrics)

    def motion(
        self,
        name: str,
        rest: RestModel,
        options: MotionOptions,
        cameras: Sequence[str] | None = None,
        looks: Looks | None = None,
    ) -> dict[str, Any]:
        """Train one motion field and score it, as it is on disk, on the test views.

        Args:
            name: Folder of this case, below the seed's.
            rest: The scene at rest.
            options: Of the motion.
            cameras: Names of the training cameras to use; None: all.
            looks: Takes looks at the model while it is trained.
        Returns:
            `evaluate`'s blocks, `train` (what the training measured), `model_mb`, and `looks`.
        """
        scene = self.scene
        if cameras is not None:
            kept = tuple(f for f in scene.dynamic if f.split == "test" or f.camera_name in cameras)
            scene = replace(scene, dynamic=kept)
        folder, device = self.out / f"seed{options.seed}" / name, self.run.device

        def train(checkpoint: Checkpoint, progress: Progress) -> dict[str, Any]:
            watch = looks.of_motion(rest) if looks is not None else None
            training = TrainingRun(device, progress, checkpoint, watch)
            estimator = partial(flow_estimator, self.run.config, self.run.scene_dir, device)
            trained, facts = recipe.motion(scene, rest, self.flows, options, training, estimator)
            files = save_deformation(folder, trained)
            model = load_deformation(folder, rest, device)
            assert trained.motion is not None
            model_mb = sum(f.stat().st_size for f in (*files, self._rest_file(options.seed))) / 1e6
            for file in files:
                file.unlink()  # a gigabyte each at the published size
            result = self.scores(scene, partial(render_view, model), folder)
            result |= {"train": {k: v for k, v in facts.items() if k != "curve"}, "model_mb": model_mb}
            return result | ({"looks": looks.taken()} if looks is not None else {})

        of = self.fingerprint(options, rest.metrics.get("of"), cameras)
        return self.once(options.seed, name, of, train)

    def scores(self, scene: Scene, render: Render, folder: Path) -> dict[str, Any]:
        """`evaluate`'s blocks of what is compared: the moving views, not the pictures at rest that were held out."""
        moving_only = replace(scene, static=tuple(f for f in scene.static if f.split == "train"))
        found = evaluate(moving_only, render, self.lpips, folder)
        return {k: found[k] for k in ("test", "test_moving", "test_rest", "static_baseline", "render_fps")}

    def publish(
        self,
        title: str | None,
        rows: Sequence[Row],
        path: Path,
        seeds: Sequence[int],
        chart: Path | None = None,
        **more: Any,
    ) -> list[Row]:
        """Print the rows, and write them with what they are of."""
        return publish(self.run.talk, title, rows, path, chart, **more, **about(self, seeds))

    def once(
        self, seed: int, name: str, of: str, train: Callable[[Checkpoint, Progress], dict[str, Any]]
    ) -> dict[str, Any]:
        """What a training measures, now or when it was made before with the same fingerprint `of`."""
        folder = self.out / f"seed{seed}" / name
        file = folder / "metrics.json"
        found = json.loads(file.read_text()) if file.is_file() else {}
        if found.get("of") != of:
            folder.mkdir(parents=True, exist_ok=True)
            checkpoint = Checkpoint(folder / "checkpoint.safetensors", of)
            with self.run.talk.progress(f"seed {seed}: {name}") as progress:
                found = train(checkpoint, progress) | {"of": of}
            file.write_text(json.dumps(found, indent=1, allow_nan=False) + "\n")
            checkpoint.remove()
        return found

    def _rest_file(self, seed: int) -> Path:
        return self.out / f"seed{seed}" / "rest" / "model.safetensors"

    def fingerprint(self, *parts: Any) -> str:
        """Of the scene, its flow, the code that trains, and what else decides a training."""
        stamps = [(self.run.run_dir / name / STAMP).read_text() for name in ("scene", "flow")]
        plain = [asdict(p) if isinstance(p, (CanonicalOptions, MotionOptions)) else p for p in parts]
        code = code_version("capture", "flow", "reconstruct", "lab/bench/training", "lab/methods")
        return hashlib.sha256(json.dumps([plain, stamps, code, self.run.device]).encode()).hexdigest()


def score_rows(
    name: str, results: Sequence[dict[str, Any]], anchors: dict[str, float] | None = None, source: str = ""
) -> list[Row]:
    """Means and spreads over seeds of PSNR, SSIM and LPIPS on the test views, and of PSNR where it moves."""
    rows = []
    for block, metrics in (("test", METRICS), ("test_moving", ("psnr",))):
        for metric in metrics:
            values = [r[block][metric] for r in results if r[block][metric] is not None]
            why = results[0][block].get("why", {}).get(metric, "not computed") if not values else None
            anchor = (anchors or {}).get(metric) if block == "test" else None
            said = None if anchor is None else source
            of = (float(np.mean(values)) if values else None, UNITS[metric], spread(values), anchor, said)
            rows.append(Row(f"{name}/{block}/{metric}", *of, why=why))
    seconds = [r["train"]["seconds"] for r in results]
    return [*rows, Row(f"{name}/seconds", float(np.mean(seconds)), "s", spread(seconds))]


def spread(values: Sequence[float]) -> float | None:
    """Standard deviation over seeds; None for fewer than two."""
    return float(np.std(values, ddof=1)) if len(values) > 1 else None


def about(bench: Bench, seeds: Sequence[int]) -> dict[str, Any]:
    """What a JSON of results has to say beside its rows."""
    config, scene = bench.run.config, bench.scene
    camera = scene.dynamic[0].camera.scaled(scene.image_scale)
    return {
        "scene": config.name,
        "pictures": {
            "width": camera.width,
            "height": camera.height,
            "static": sum(f.split == "train" for f in scene.static),
            "cameras": len({f.camera_name for f in scene.dynamic if f.split == "train"}),
            "times": len({f.time for f in scene.dynamic}),
        },
        "preset": config.preset,
        "reconstruct": config.reconstruct.model_dump(exclude_none=True, exclude={"seed"}),
        "device": device_name(bench.run.device),
        "seeds": list(seeds),
        "versions": versions(),
    }


def device_name(device: str) -> str:
    """The device in words."""
    if device == "cuda":
        return torch.cuda.get_device_name()
    return f"CPU ({platform.machine()}, {len(os.sched_getaffinity(0))} cores)"
