"""Health rows about light: exposure, white balance and lamps in clips; settings of photos; levels of RAW."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from devrf.calibration.flicker import EXPOSURE_STOPS, LightFound, judge_light
from devrf.capture.frames import FrameSet, places
from devrf.capture.light import CLIPPED_SHARE, LightCourse
from devrf.capture.raw_set import read_raw_sidecar
from devrf.pipelines.health.rows import HealthRow, listed, note

BELOW_BLACK_SHARE = 0.05  # of the sensor's values
FLOOR_SHARE = 0.02  # of the range, where a file says that black is 0: sensors put black at 1.6 % and more
WHITE_SHARE = 0.97  # of the white level: sensors saturate within 3 % of what their files say
PILED_UP = 20.0  # times more values at the highest than below it: that is where the sensor saturates
BALANCE_SHARE = 0.01  # cameras round their multipliers to less
FEWEST_ALIKE = 3  # cameras: two may do the same by chance
ALIKE = 2.0  # times the smallest change that the largest may be: cameras look at other parts of the scene
PHOTO_STOPS = 0.1  # a third of a camera's smallest step


def light_rows(frames: FrameSet, folder: Path) -> list[HealthRow]:
    """Rows about the clips of the fixed cameras and all photos of an ingest folder."""
    rows: list[HealthRow] = []
    found, tests = (
        {
            name: judge_light(LightCourse.read(path))
            for name in cameras
            if (path := folder / "light" / f"{name}.npy").is_file()
        }
        for cameras in (frames.trained, frames.tests)
    )
    if changes_alike(found):
        rows.append(_scene_row(list(found.values())))
        found, tests = (
            {name: replace(light, exposure=None) for name, light in some.items()} for some in (found, tests)
        )
    for name, light in found.items():
        rows += clip_rows(name, frames.cameras[name].source, light, trains=True)
    if found and not rows:
        rows.append(note("light of the fixed cameras", "steady"))
    for name, light in tests.items():
        rows += clip_rows(name, frames.cameras[name].source, light, trains=False)
    for path in sorted((folder / "raw").glob("*.json")):
        sidecar = read_raw_sidecar(path)
        rows += raw_rows(path.stem, sidecar)
        rows += exposure_rows(path.stem, {f["source"]: f["exposure_stops"] for f in sidecar["files"]})
    for name, camera in frames.cameras.items():
        photos = {f.place: f.exif.exposure_stops for f in camera.used if f.exif is not None}
        rows += exposure_rows(name, photos)
    return rows


def changes_alike(found: Mapping[str, LightFound]) -> bool:
    """Whether all of several cameras get brighter, or all darker, by about as much: so does the scene.

    When is not asked, because clocks are not known yet.
    """
    stops = [0.0 if light.exposure is None else light.exposure.stops for light in found.values()]
    low, high = min(map(abs, stops), default=0.0), max(map(abs, stops), default=0.0)
    same_way = len({s > 0 for s in stops}) == 1
    return len(stops) >= FEWEST_ALIKE and same_way and 0 < low and high <= ALIKE * low


def _scene_row(found: list[LightFound]) -> HealthRow:
    stops = [light.exposure.stops for light in found if light.exposure is not None]
    return _light_row(
        "light of the scene",
        f"all {len(stops)} fixed cameras see it change by {min(stops):+.2f} to {max(stops):+.2f} EV",
        max(light.left for light in found),
        "A lamp, the sun or a screen changes: keep the light as it is in the sweep. If all cameras choose their "
        "exposure by themselves, lock it.",
    )


@listed
def clip_rows(name: str, source: str, light: LightFound, trains: bool = True) -> Iterator[HealthRow]:
    """Rows about one clip; none where its light is steady.

    Args:
        name: Of the camera.
        source: Its clip.
        light: What changes in it.
        trains: Whether gains are to make up for it; pictures of test cameras are compared as they were filmed.
    """
    left = light.left if trains else None
    if light.known < 0.5:
        yield note(f"light of {name}", "not measured: what moves fills most of the picture")
    if light.exposure is not None:
        yield _light_row(
            f"exposure of {name}",
            f"{light.exposure.stops:+.2f} EV {_when(light.exposure.from_s, light.exposure.to_s)}",
            left,
            f"{source}: exposure is automatic; set shutter, gain and aperture by hand and lock them.",
        )
    if light.colour is not None:
        share = 100 * (2**light.colour.stops - 1)
        yield _light_row(
            f"white balance of {name}",
            f"red or blue against green {share:+.0f} % {_when(light.colour.from_s, light.colour.to_s)}",
            left,
            f"{source}: white balance is automatic; set it by hand and lock it.",
        )
    if light.flicker is not None:
        yield note(
            f"flicker of {name}",
            f"by {100 * light.flicker.depth:.0f} %, seen {light.flicker.seen_hz:.2f} times a second",
            remedy=f"{source}: set the shutter to the period of the lamps (1/50 or 1/100 s on mains of 50 Hz, 1/60 or "
            "1/120 s on 60 Hz), or light without mains lamps.",
        )


def _light_row(check: str, change: str, left: float | None, remedy: str) -> HealthRow:
    """A change of light: healthy where gains make up for it, so that no more is left than a steady clip may change."""
    if left is None:
        return note(check, f"{change}; test pictures stay as they were filmed", remedy=remedy)
    share = 100 * (2**left - 1)
    if left <= EXPOSURE_STOPS:
        return note(check, f"{change}; gains make up for it: {share:.1f} % is left")
    return note(check, f"{change}; gains leave {share:.0f} %", remedy=remedy)


def raw_rows(name: str, sidecar: dict[str, Any]) -> list[HealthRow]:
    """Rows about one folder of RAW photos; none where all were taken alike and well exposed."""
    recipe, files = sidecar["recipe"], sidecar["files"]
    rows = []

    def say(check: str, found: list[dict[str, Any]], text: str, remedy: str = "") -> None:
        if found:
            words = f"{len(found)} of {len(files)} files {text}: {places([f['source'] for f in found])}"
            rows.append(note(f"{check}, {name}", words, remedy=remedy))

    shot = [f for f in files if f["as_shot"] is not None]
    usual = np.median([f["as_shot"] for f in shot], axis=0) if shot else np.ones(3)
    other = [f for f in shot if np.abs(np.array(f["as_shot"]) / usual - 1).max() > BALANCE_SHARE]
    say("white balance of RAW photos", other, "have another white balance; one is used for all")
    turned = [f for f in files if f["turn_deg"] != recipe["turn_deg"]]
    say("turn of RAW photos", turned, f"ask for another turn; all are turned by {recipe['turn_deg']} degrees")
    say(
        "white level of RAW photos",
        [f for f in files if f["white"] != recipe["white"]],
        f"have another white level; {recipe['white']} is used for all",
        "Keep one camera in one mode (ISO, compression, bit depth) for the whole set.",
    )
    say(
        "highlights of RAW photos",
        [f for f in files if f["clipped"] > CLIPPED_SHARE],
        f"have more than {100 * CLIPPED_SHARE:.0f} % of the picture at white "
        f"(up to {100 * max(f['clipped'] for f in files):.0f} %)",
        "Lower the exposure until the brightest surface is below white.",
    )
    say(
        "black level of RAW photos",
        [f for f in files if f["below_black"] > BELOW_BLACK_SHARE],
        f"have more than {100 * BELOW_BLACK_SHARE:.0f} % of the sensor's values below their black level",
        "The file's black level is too high for this sensor: convert the photos with the maker's DNG converter.",
    )
    if all(max(f["black"]) == 0 and f["floor"] > FLOOR_SHARE for f in files):
        darkest = min(f["floor"] for f in files)
        say(
            "black level of RAW photos",
            files,
            f"say that black is 0, but nothing is darker than {100 * darkest:.1f} % of white",
            "Black was not removed: convert the photos with the maker's DNG converter.",
        )
    say(
        "white level of RAW photos",
        [f for f in files if f["at_highest"] > PILED_UP and f["highest"] < WHITE_SHARE * recipe["white"]],
        f"saturate at {max(f['highest'] for f in files)}, below the white level {recipe['white']}",
        "The file's white level is too high for this sensor: highlights come out grey; lower the exposure.",
    )
    return rows


def exposure_rows(name: str, stops: Mapping[str, float | None]) -> list[HealthRow]:
    """A row about a folder of photos whose settings give them unequal light; none where all are alike or unknown."""
    known = {photo: value for photo, value in stops.items() if value is not None}
    middle = float(np.median(list(known.values()))) if known else 0.0
    off = [photo for photo, value in known.items() if abs(value - middle) > PHOTO_STOPS]
    if not off:
        return []
    span = max(known.values()) - min(known.values())
    return [
        note(
            f"exposure of photos, {name}",
            f"{len(off)} of {len(known)} photos are exposed unlike most, up to {span:.1f} EV apart: {places(off)}",
            remedy="Set shutter, ISO and aperture by hand and lock them for the whole set.",
        )
    ]


def _when(from_s: float, to_s: float) -> str:
    return f"at {from_s:.2f} s" if to_s - from_s < 0.1 else f"between {from_s:.2f} and {to_s:.2f} s"
