"""Four small stages that write text, on two files: for tests of the runner."""

from collections.abc import Callable
from operator import attrgetter
from pathlib import Path

from devrf.capture.measure import Measure
from devrf.pipelines.config.load import load_scene
from devrf.pipelines.runner.execute import execute
from devrf.pipelines.runner.run_state import Run
from devrf.pipelines.runner.standing import Choice, Standing
from devrf.pipelines.stage import Stage, StageContext
from devrf.pipelines.terminal.console import Talk
from devrf.pipelines.terminal.exit_codes import DONE

ALL = ["first", "second", "other", "third"]
CHAIN = ["first", "second", "third"]  # what the sweep changes
MADE_OF = "made_of.txt"
SCENE = """
name: small
output: run
preset: tiny
capture: {static: static.mp4, cameras: {cam0: cam0.mp4}}
reconstruct: {rays: 100, seed: 1}
"""


def write(text: str) -> Callable[[StageContext], None]:
    def work(context: StageContext) -> None:
        context.progress(0.5, "half")
        (context.out / "sub").mkdir()
        (context.out / "sub" / "result.txt").write_text(text)
        context.measures.append(Measure("sweep-overlay", 0.0))

    return work


def stage(name: str, reads: tuple[str, ...], keys: tuple[str, ...], work: Callable | None = None) -> Stage:
    """A stage whose result follows from what it reads: another key or file, another result."""

    def run(context: StageContext) -> None:
        (work or write(name))(context)
        made_of = [
            file.read_text() for other in reads if (file := context.run_dir / other / MADE_OF).exists()
        ]
        for key in keys:
            value = attrgetter(key)(context.config) if context.config.capture else None
            files = value.values() if isinstance(value, dict) else [value] if isinstance(value, str) else []
            made_of += [(context.scene_dir / file).read_text() for file in files] or [str(value)]
        (context.out / MADE_OF).write_text(f"{name}({', '.join(made_of)})")

    return Stage(name, reads, keys, lambda config: None, run)


def small_stages(**works: Callable[[StageContext], None]) -> tuple[Stage, ...]:
    """first reads the sweep; second reads first; third reads second; other reads only the other clip."""
    return (
        stage("first", (), ("capture.static",), works.get("first")),
        stage("second", ("first",), ("reconstruct.rays",), works.get("second")),
        stage("other", (), ("capture.cameras", "reconstruct.seed"), works.get("other")),
        stage("third", ("second",), (), works.get("third")),
    )


def job(folder: Path, stages: tuple[Stage, ...], *overrides: str, choice: Choice | None = None) -> Run:
    config = load_scene(folder / "scene.yaml", overrides)
    return Run(config, folder, stages, choice or Choice(), Talk("quiet"))


def executed(folder: Path, *overrides: str, choice: Choice | None = None, **works: Callable) -> list[str]:
    run = job(folder, small_stages(**works), *overrides, choice=choice)
    assert execute(run) == DONE
    return run.executed


def stand(folder: Path, *overrides: str) -> dict[str, Standing]:
    """Where each of them stands."""
    return {now.stage.name: now for now in job(folder, small_stages(), *overrides).standings()}
