"""The pipeline as a list: which stage reads what, on which keys it depends, and to which captures it applies.

The work of each stage is in the file of its name, which is imported only when the stage runs, so that
`status` needs neither torch nor pycolmap.
"""

from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from devrf.flow.methods import installed, plug_in
from devrf.pipelines.stage import Stage, StageContext
from devrf.reconstruct.options import OWN_MOTION

if TYPE_CHECKING:
    from devrf.pipelines.config.scene import SceneConfig


def _glue(module: str) -> Callable[[StageContext], None]:
    """`run` of devrf.pipelines.stages.<module>, imported at the first call."""

    def run(context: StageContext) -> None:
        import_module(f"{__name__}.{module}").run(context)

    return run


NO_RAW_FILES = "a finished data set brings its own cameras"
NO_SWEEP = "the capture has no sweep of the scene at rest"
NO_CAMERAS = "the capture has no cameras of the moving scene (only a sweep)"
NOTHING_MOVES = "nothing in this data set moves: it has no training pictures with times"
PAIRS = {"intri": "extri", "extri": "intri", "intrinsics": "extrinsics", "extrinsics": "intrinsics"}


def _unless(**reasons: str) -> Callable[["SceneConfig"], str | None]:
    """A stage that applies to all kinds of scene but some."""
    return lambda config: reasons.get(config.kind)


def _where_something_moves(config: "SceneConfig") -> str | None:
    if config.dataset is not None and config.dataset.at_rest:
        return NOTHING_MOVES
    return NO_CAMERAS if config.kind == "sweep" else None


def _where_rest_is_known_and_something_moves(config: "SceneConfig") -> str | None:
    return NO_SWEEP if config.kind == "cameras" else _where_something_moves(config)


def _truth(config: "SceneConfig", scene_dir: Path) -> dict[str, Path]:
    truth = config.truth_path(scene_dir)
    if truth is None:
        return {}
    masks = sorted(truth.parent.glob("*_mask.npz")) if truth.parent.is_dir() else []
    return {"ground truth": truth} | {f"masks {path.name}": path for path in masks}


def _beside_given(config: "SceneConfig", scene_dir: Path) -> dict[str, Path]:
    """A calibration in two files is named by one of them; both count."""
    given = config.calibration.rig.given
    path = config.path(scene_dir, given) if isinstance(given, str) else None
    if path is None or path.stem not in PAIRS:
        return {}
    other = path.with_name(PAIRS[path.stem]).with_suffix(path.suffix)
    return {f"{other.stem} of calibration.rig.given": other}


def _data_set(config: "SceneConfig", scene_dir: Path) -> dict[str, Path]:
    """The pictures of a data set stay where they are."""
    return {} if config.dataset is None else {"dataset": config.path(scene_dir, config.dataset.path)}


def _flow_method(config: "SceneConfig") -> tuple[str, ...]:
    module = plug_in(config.flow.method)
    return () if module is None else (module,)


def _flow_and_motion(config: "SceneConfig") -> tuple[str, ...]:
    name = config.reconstruct.motion
    return (*_flow_method(config), *(() if name == "auto" else (installed(OWN_MOTION)[name].module,)))


PRINTED_BOARD = tuple(  # how the board looks; its clips are read by ingest alone
    f"capture.board.{key}"
    for key in (
        *("type", "squares", "square_m", "marker_m", "separation_m"),
        *("dictionary", "inverted", "legacy", "lens"),
    )
)

TRAINING = tuple(
    f"reconstruct.{key}" for key in ("resolution", "rays", "canonical_iterations", "adapt", "seed")
)

CAMERAS = ("capture", "calibration")  # rooms whose code stages need
TRAINED = ("capture", "flow", "reconstruct")

STAGES = (
    Stage(
        name="ingest",
        reads=(),
        config_keys=(
            "capture.static",
            "capture.cameras",
            "capture.test_cameras",
            "capture.timestamps",
            "capture.range_s",
            "capture.board.clips",
            "capture.board.joint_clips",
            "capture.raw",
            "calibration.sync.method",
        ),
        applies=_unless(dataset=NO_RAW_FILES),
        run=_glue("ingest"),
        rooms=CAMERAS,
    ),
    Stage(
        name="static_poses",
        reads=("ingest",),
        config_keys=("calibration.static_poses", "capture.static", *PRINTED_BOARD),
        applies=_unless(dataset=NO_RAW_FILES, cameras=NO_SWEEP),
        run=_glue("static_poses"),
        rooms=CAMERAS,
    ),
    Stage(
        name="sync",
        reads=("ingest",),
        config_keys=("calibration.sync", "capture.rest"),
        applies=_unless(dataset=NO_RAW_FILES, sweep=NO_CAMERAS),
        run=_glue("sync"),
        rooms=CAMERAS,
    ),
    Stage(
        name="rig",
        reads=("ingest", "static_poses", "sync"),
        config_keys=(
            *PRINTED_BOARD,
            "capture.board.metric",
            "capture.rest",
            "calibration.rig",
            "evaluate.holdout_every",
        ),
        applies=_unless(dataset=NO_RAW_FILES, sweep=NO_CAMERAS),
        run=_glue("rig.rig_stage"),
        rooms=CAMERAS,
        inputs=_beside_given,
    ),
    Stage(
        name="colour",
        reads=("ingest", "static_poses", "sync", "rig"),
        config_keys=("calibration.colour", "capture.rest", "evaluate.holdout_every"),
        applies=_unless(dataset=NO_RAW_FILES),
        run=_glue("colour"),
        rooms=CAMERAS,
    ),
    Stage(
        name="scene",
        reads=("ingest", "static_poses", "sync", "rig", "colour"),
        config_keys=(
            "preset",
            "dataset",
            "capture.static",
            "capture.cameras",
            "capture.test_cameras",
            "capture.rest",
            "capture.range_s",
            "capture.mattes",
            "reconstruct.image_scale",
            "reconstruct.resolution",
            "evaluate.holdout_every",
        ),
        applies=_unless(),
        run=_glue("scene.scene_stage"),
        rooms=(*CAMERAS, "reconstruct"),
        refers=True,
        places=_data_set,
    ),
    Stage(
        name="flow",
        reads=("scene",),
        config_keys=("flow",),
        applies=_where_something_moves,
        run=_glue("flow"),
        rooms=("capture", "flow"),
        plug_ins=_flow_method,
    ),
    Stage(
        name="canonical",
        reads=("scene",),
        config_keys=(  # the other keys of `reconstruct` are about the motion, or the scene's
            "preset",
            *TRAINING,
        ),
        applies=_unless(cameras=NO_SWEEP),
        run=_glue("canonical"),
        rooms=TRAINED,
    ),
    Stage(
        name="deformation",
        reads=("sync", "scene", "flow", "canonical"),
        config_keys=(  # all of `reconstruct` but image_scale, which is the scene's
            "preset",
            *TRAINING,
            "reconstruct.motion_iterations",
            "reconstruct.key_times",
            "reconstruct.motion",
            "flow",
        ),
        applies=_where_rest_is_known_and_something_moves,
        run=_glue("deformation"),
        rooms=(*TRAINED, "calibration/clocks"),
        plug_ins=_flow_and_motion,
    ),
    Stage(
        name="evaluate",
        reads=("ingest", "static_poses", "sync", "rig", "scene", "canonical", "deformation"),
        config_keys=("evaluate.lpips_weights", "reconstruct.seed", "capture.test_cameras"),
        applies=_unless(cameras=NO_SWEEP),
        run=_glue("evaluate"),
        rooms=(*TRAINED, "calibration"),
        inputs=_truth,
    ),
    Stage(
        name="render",
        reads=("scene", "canonical", "deformation"),
        config_keys=("preset",),
        applies=_unless(cameras=NO_SWEEP),
        run=_glue("render"),
        rooms=("capture", "reconstruct"),
    ),
    Stage(
        name="report",
        reads=(
            "ingest",
            "static_poses",
            "sync",
            "rig",
            "colour",
            "scene",
            "flow",
            "canonical",
            "deformation",
            "evaluate",
            "render",
        ),
        config_keys=("name", "preset"),
        applies=_unless(cameras=NO_SWEEP),
        run=_glue("report"),
        rooms=("capture", "flow", "pipelines/report"),
        quotes_stamps=True,
    ),
)


def stage_names() -> tuple[str, ...]:
    """Names of all stages, in the order they run."""
    return tuple(stage.name for stage in STAGES)


def up_to(last: str) -> tuple[str, ...]:
    """Names of the stages that run no later than one, itself included."""
    names = stage_names()
    return names[: names.index(last) + 1]
