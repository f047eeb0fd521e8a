"""Colours of four webcams with different exposure and white balance brought to the first one's look.

`caliscope_post_optimization` goes through the pipeline's own stages up to `colour`, with caliscope's own calibration:
only colours are measured. The error is the root mean square difference of sRGB channels in [0, 1] between two cameras,
over the surface points that both see and no fit has seen (a quarter of the picture's tiles).
"""

import yaml

from devrf.calibration.colour.result import Colours, read_colours
from devrf.capture.errors import CalibrationError
from devrf.pipelines.bench.accuracy.cases import Cases, not_there
from devrf.pipelines.bench.accuracy.rigs import write_times
from devrf.pipelines.bench.rows import Row, with_goal
from devrf.pipelines.cli_options import configured
from devrf.pipelines.exit_codes import DONE
from devrf.pipelines.runner.execute import execute
from devrf.pipelines.runner.plan import Choice
from devrf.pipelines.runner.run import Run
from devrf.pipelines.stages import STAGES

CAPTURE = "caliscope_post_optimization"
LEFT = 1 / 3  # goal: of the difference before
UNIT = "rms of sRGB"


def colour(cases: Cases) -> list[Row]:
    """How far the cameras lie apart, before and after."""
    folder = cases.real(CAPTURE)
    if folder is None:
        return [not_there(f"colour/{CAPTURE}", UNIT, CAPTURE)]
    work = cases.out / "colour" / CAPTURE
    work.mkdir(parents=True, exist_ok=True)
    clips = {f"cam{n}": str(folder / "calibration" / "extrinsic" / f"cam_{n}.mp4") for n in range(4)}
    write_times(folder / "calibration" / "extrinsic" / "timestamps.csv", work / "times.csv")
    content = {
        "name": CAPTURE,
        "output": "run",
        "preset": "tiny",
        "capture": {"cameras": clips, "timestamps": "times.csv"},
        "calibration": {"rig": {"given": str(folder / "camera_array.toml")}},
    }
    scene = work / "scene.yaml"
    scene.write_text(yaml.safe_dump(content))
    config, scene_dir = configured(scene, None, None)
    run = Run(config, scene_dir, STAGES, Choice(last="colour"), cases.talk)
    if execute(run) != DONE:
        raise CalibrationError(f"{CAPTURE}: the stages up to colour failed; see {run.run_dir}/devrf.log")
    return _rows(read_colours(run.run_dir / "colour"))


def _rows(colours: Colours) -> list[Row]:
    prefix, total = f"colour/{CAPTURE}", colours.total
    if total.before is None or total.after is None:
        return [Row(prefix, None, UNIT, why="the cameras share no surface point")]
    rows = [
        Row(f"{prefix}/surface points kept out of the fit", float(total.points), ""),
        Row(f"{prefix}/cameras apart, before", total.before, UNIT),
        Row(f"{prefix}/cameras apart, after", total.after, UNIT),
        with_goal(Row(f"{prefix}/after over before", total.after / total.before, ""), LEFT, low_is_good=True),
    ]
    for name, camera in colours.cameras.items():
        if name != colours.reference:
            rows += [
                Row(f"{prefix}/{name} ({camera.kind}), before", camera.apart.before, UNIT),
                Row(f"{prefix}/{name} ({camera.kind}), after", camera.apart.after, UNIT),
            ]
    return rows
