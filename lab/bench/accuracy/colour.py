"""Colours of four webcams with different exposure and white balance brought to the first one's look.

`caliscope_post_optimization` goes through the pipeline's own stages up to `colour`, with caliscope's own calibration:
only colours are measured. The error is the root mean square difference of sRGB channels in [0, 1] between two cameras,
over the surface points that both see and no fit has seen (a quarter of the picture's tiles).
"""

from devrf.calibration.colour.colours import read_colours
from devrf.lab.bench.accuracy.cases import Cases, not_there
from devrf.lab.bench.accuracy.rigs import run_caliscope
from devrf.lab.bench.bench_rows import Row

CAPTURE = "caliscope_post_optimization"
LEFT = 1 / 3  # goal: of the difference before
UNIT = "rms of sRGB"


def colour(cases: Cases) -> list[Row]:
    """How far the cameras lie apart, before and after."""
    folder, prefix = cases.real(CAPTURE), f"colour/{CAPTURE}"
    if folder is None:
        return [not_there(prefix, UNIT, CAPTURE)]
    given = {"calibration": {"rig": {"given": str(folder / "camera_array.toml")}}}
    run = run_caliscope(cases.folder(prefix), folder, "colour", given, cases.talk)
    colours = read_colours(run.run_dir / "colour")
    total = colours.total
    if total.before is None or total.after is None:
        return [Row(prefix, None, UNIT, why="the cameras share no surface point")]
    apart = {"cameras apart": total} | {
        f"{name} ({camera.kind})": camera.apart
        for name, camera in colours.cameras.items()
        if name != colours.reference
    }
    return [
        Row(f"{prefix}/surface points kept out of the fit", float(total.points), ""),
        Row(f"{prefix}/after over before", total.after / total.before, "").at_most(LEFT),
        *(
            Row(f"{prefix}/{name}, {when}", getattr(of, when), UNIT)
            for name, of in apart.items()
            for when in ("before", "after")
        ),
    ]
