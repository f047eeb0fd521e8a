"""Stage `rig`: the fixed cameras in one world with the sweep, their doubts, and the length of a unit."""

from dataclasses import replace

from devrf.calibration.rigs.rig import write_rig
from devrf.capture.measure import of_test
from devrf.pipelines.health.board_rows import board_measures
from devrf.pipelines.health.rig_rows import (
    scale_measures,
)
from devrf.pipelines.stage import StageContext
from devrf.pipelines.stages.rig.rig_job import RigJob
from devrf.pipelines.stages.rig.rig_routes import (
    from_board,
    from_given,
    from_sweep,
    look_for_bumps,
    route,
    with_test_cameras,
)


def run(context: StageContext) -> None:
    """Write `rig.json`, and in `clean/` the pictures of the fixed cameras that were registered."""
    job = RigJob(context)
    rig = {"given": from_given, "sweep": from_sweep, "board": from_board}[route(job)](job)
    rig = with_test_cameras(job, rig)
    look_for_bumps(job, rig)
    told = {
        n: c.details | {"board": job.boards[n].as_dict()} for n, c in rig.cameras.items() if n in job.boards
    }
    cameras = {n: replace(c, details=told.get(n, c.details)) for n, c in rig.cameras.items()}
    write_rig(context.out / "rig.json", replace(rig, cameras=cameras))
    for name, calibration in job.boards.items():
        found = board_measures(name, calibration)
        context.measures += found if name in job.trained else of_test(name, found)
    unmeasured_board = job.spec is not None and not job.board_is_measured
    context.measures += [*job.measures, *scale_measures(job.scales, rig.scale, unmeasured_board)]
