"""Light: exposure, white balance and lamps in clips; settings of photos; levels of RAW."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from devrf.calibration.colour.flicker import EXPOSURE_STOPS, LightFound, judge_light
from devrf.capture.colour.light_course import CLIPPED_SHARE, LightCourse
from devrf.capture.frames import FrameSet, some
from devrf.capture.measure import Measure, noted
from devrf.capture.photos.raw_set import read_raw_sidecar

BELOW_BLACK_SHARE = 0.05  # of the sensor's values
FLOOR_SHARE = 0.02  # of the range, where a file says that black is 0: sensors put black at 1.6 % and more
WHITE_SHARE = 0.97  # of the white level: sensors saturate within 3 % of what their files say
PILED_UP = 20.0  # times more values at the highest than below it: that is where the sensor saturates
BALANCE_SHARE = 0.01  # cameras round their multipliers to less
FEWEST_ALIKE = 3  # cameras: two may do the same by chance
ALIKE = 2.0  # times the smallest change that the largest may be: cameras look at other parts of the scene
PHOTO_STOPS = 0.1  # a third of a camera's smallest step


def light_measures(frames: FrameSet, folder: Path) -> Iterator[Measure]:
    """The clips of the fixed cameras and all photos of an ingest folder."""
    found, tests = (
        {
            name: judge_light(LightCourse.read(path))
            for name in cameras
            if (path := folder / "light" / f"{name}.npy").is_file()
        }
        for cameras in (frames.trained, frames.tests)
    )
    if changes_alike(found):
        stops = [light.exposure.stops for light in found.values() if light.exposure is not None]
        change = f"all {len(stops)} fixed cameras see it change by {min(stops):+.2f} to {max(stops):+.2f} EV"
        yield _light("scene", "", change, max(light.left for light in found.values()), "")
        found, tests = (
            {name: replace(light, exposure=None) for name, light in some.items()} for some in (found, tests)
        )
    for name, light in (found | tests).items():
        yield from clip_measures(name, frames.cameras[name].source, light, trains=name in found)
    for path in sorted((folder / "raw").glob("*.json")):
        sidecar = read_raw_sidecar(path)
        yield from raw_measures(path.stem, sidecar)
        yield from exposure_measures(path.stem, {f["source"]: f["exposure_stops"] for f in sidecar["files"]})
    for name, camera in frames.cameras.items():
        photos = {f.place: f.exif.exposure_stops for f in camera.used if f.exif is not None}
        yield from exposure_measures(name, photos)


def changes_alike(found: Mapping[str, LightFound]) -> bool:
    """Whether all of several cameras get brighter, or all darker, by about as much: so does the scene.

    When is not asked, because clocks are not known yet.
    """
    stops = [0.0 if light.exposure is None else light.exposure.stops for light in found.values()]
    low, high = min(map(abs, stops), default=0.0), max(map(abs, stops), default=0.0)
    same_way = len({s > 0 for s in stops}) == 1
    return len(stops) >= FEWEST_ALIKE and same_way and 0 < low and high <= ALIKE * low


def clip_measures(name: str, source: str, light: LightFound, trains: bool = True) -> Iterator[Measure]:
    """What changes in one clip; none where its light is steady.

    Args:
        name: Of the camera.
        source: Its clip.
        light: What changes in it.
        trains: Whether gains are to make up for it; pictures of test cameras are compared as they were filmed.
    """
    left = light.left if trains else None
    if light.exposure is not None:
        when = _when(light.exposure.from_s, light.exposure.to_s)
        yield _light("exposure", name, f"{light.exposure.stops:+.2f} EV {when}", left, source)
    if light.colour is not None:
        share, when = 100 * (2**light.colour.stops - 1), _when(light.colour.from_s, light.colour.to_s)
        yield _light("colour", name, f"red or blue against green {share:+.0f} % {when}", left, source)
    if light.flicker is not None:
        text = (
            f"flickers by {100 * light.flicker.depth:.0f} %, seen {light.flicker.seen_hz:.2f} times a second"
        )
        yield Measure("light-changes", text, name, "flicker", {"source": source})


def _light(why: str, name: str, change: str, left: float | None, source: str) -> Measure:
    """A change of light: healthy where gains make up for it, so that no more is left than a steady clip may change."""
    share = 100 * (2 ** (left or 0.0) - 1)
    mended = left is not None and left <= EXPOSURE_STOPS
    text = (
        f"{change}; test pictures stay as they were filmed"
        if left is None
        else f"{change}; gains make up for it: {share:.1f} % is left"
        if mended
        else f"{change}; gains leave {share:.0f} %"
    )
    return Measure("light-changes", text, name, why, {"source": source}, found="ok" if mended else "warn")


def raw_measures(name: str, sidecar: dict[str, Any]) -> Iterator[Measure]:
    """One folder of RAW photos; none where all were taken alike and well exposed."""
    recipe, files = sidecar["recipe"], sidecar["files"]

    def of(found: list[dict[str, Any]], text: str) -> str:
        return f"{len(found)} of {len(files)} files {text}: {some([f['source'] for f in found])}"

    shot = [f for f in files if f["as_shot"] is not None]
    usual = np.median([f["as_shot"] for f in shot], axis=0) if shot else np.ones(3)
    other = [f for f in shot if np.abs(np.array(f["as_shot"]) / usual - 1).max() > BALANCE_SHARE]
    turned = [f for f in files if f["turn_deg"] != recipe["turn_deg"]]
    said = [of(other, "have another white balance; one is used for all")] if other else []
    if turned:
        said.append(of(turned, f"ask for another turn; all are turned by {recipe['turn_deg']} degrees"))
    yield from noted(said, name)
    clipped = f"(up to {100 * max(f['clipped'] for f in files):.0f} %)"
    piled = [f for f in files if f["at_highest"] > PILED_UP and f["highest"] < WHITE_SHARE * recipe["white"]]
    kept = all(max(f["black"]) == 0 and f["floor"] > FLOOR_SHARE for f in files)
    for code, why, found, text in (
        (
            "coding",
            "white",
            [f for f in files if f["white"] != recipe["white"]],
            f"have another white level; {recipe['white']} is used for all",
        ),
        (
            "highlights",
            "raw",
            [f for f in files if f["clipped"] > CLIPPED_SHARE],
            f"have more than {100 * CLIPPED_SHARE:.0f} % of the picture at white {clipped}",
        ),
        (
            "coding",
            "black-high",
            [f for f in files if f["below_black"] > BELOW_BLACK_SHARE],
            f"have more than {100 * BELOW_BLACK_SHARE:.0f} % of the sensor's values below their black level",
        ),
        (
            "coding",
            "black-kept",
            files if kept else [],
            "say that black is 0, but nothing is darker than "
            f"{100 * min(f['floor'] for f in files):.1f} % of white",
        ),
        (
            "coding",
            "white-high",
            piled,
            f"saturate at {max(f['highest'] for f in files)}, below the white level {recipe['white']}",
        ),
    ):
        if found:
            yield Measure(code, of(found, text), name, why)


def exposure_measures(name: str, stops: Mapping[str, float | None]) -> list[Measure]:
    """A folder of photos whose settings give them unequal light; none where all are alike or unknown."""
    known = {photo: value for photo, value in stops.items() if value is not None}
    middle = float(np.median(list(known.values()))) if known else 0.0
    off = [photo for photo, value in known.items() if abs(value - middle) > PHOTO_STOPS]
    if not off:
        return []
    span = max(known.values()) - min(known.values())
    text = (
        f"{len(off)} of {len(known)} photos are exposed unlike most, up to {span:.1f} EV apart: {some(off)}"
    )
    return [Measure("light-changes", text, name, "photos")]


def _when(from_s: float, to_s: float) -> str:
    return f"at {from_s:.2f} s" if to_s - from_s < 0.1 else f"between {from_s:.2f} and {to_s:.2f} s"
