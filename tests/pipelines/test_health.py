"""The table of health: how many codes it has, that each is measured somewhere, and which values it lets pass."""

import ast
import json
import re
import string
from pathlib import Path

import pytest
from tests.docs.pages import REPOSITORY

from devrf.capture.measure import Measure, Verdict, highest, lowest, of_test
from devrf.pipelines.health.judge import Entry, entries, judge, worst

MOST_CODES = 90
TEXTS = Path(__file__).with_name("health_texts.json")
ROOMS = ("capture", "calibration", "flow", "reconstruct", "pipelines")
FORM = re.compile(r"[a-z]+(-[a-z]+){0,2}")

# code -> a value just fine, one that is just a warning, one that just fails (None: none does)
BOUNDS: dict[str, tuple[float, float | None, float | None]] = {
    "board-coverage": (0.8, 0.79, None),
    "board-error": (1.0, 1.01, 3.01),
    "board-lengths": (0.5, 0.51, None),
    "board-rig-error": (1.0, 1.01, 4.01),
    "board-tilt": (4, 3, None),
    "board-unseen": (0.3, 0.29, None),
    "board-views": (10, 9, None),
    "box-cuts": (2.0, 2.01, None),
    "box-not-swept": (20.0, 20.01, None),
    "box-one-sided": (50.0, 50.01, None),
    "box-unexplained": (15.0, 15.01, None),
    "camera-bumped": (0.5, 0.51, None),
    "camera-matches": (0.25, 0.24, None),
    "camera-moves": (0.3, 0.31, 2.01),
    "camera-points": (100, 99, 29),
    "camera-points-crowded": (0.2, 0.19, None),
    "camera-position": (0.5, 0.51, None),
    "clip-short": (10, 9, 1),
    "clock-moved": (10.0, 10.1, None),
    "clock-unknown": (0.6, 0.59, None),
    "colours-differ": (0.05, 0.051, None),
    "disk-room": (0.0, None, -0.01),
    "exposure-differs": (1.5, 1.51, None),
    "flow-consistent": (0.7, 0.69, 0.29),
    "flow-contradicted": (0.75, 0.76, None),
    "flow-large": (0.05, 0.051, None),
    "flow-moving": (0.7, 0.69, None),
    "flow-shake": (0.1, 0.11, None),
    "flow-unsure": (0.4, 0.41, None),
    "flow-warping": (0.8, 0.81, 1.06),
    "frames-dropped": (0.02, 0.021, 0.51),
    "matte-empty": (0.5, 0.51, None),
    "motion-empty": (50.0, 50.1, None),
    "motion-gain": (1.5, 1.49, None),
    "motion-late": (0.25, 0.26, None),
    "motion-leaves-box": (5.0, 5.1, 50.1),
    "motion-lost": (2.0, 3.0, None),
    "motion-one-sided": (75.0, 75.1, None),
    "motion-still": (8.0, 8.1, None),
    "rest-psnr": (18.0, 17.9, 9.9),
    "rest-unseen": (0.5, 0.51, None),
    "rig-given-moved": (1.0, 1.01, 5.01),
    "rig-link": (200, 199, 49),
    "scene-few-frames": (5, 4, 1),
    "subject-small": (0.002, 0.0019, None),
    "surface-unseen": (50.0, 50.1, None),
    "sweep-angle": (3.0, 2.9, 1.4),
    "sweep-blurred": (0.8, 0.79, 0.29),
    "sweep-centre": (5.0, 5.1, None),
    "sweep-contradicts": (5.0, 5.1, None),
    "sweep-depth": (0.1, 0.09, 0.039),
    "sweep-error": (1.0, 1.01, 2.01),
    "sweep-few-pictures": (20, 19, 2),
    "sweep-flat": (0.9, 0.91, None),
    "sweep-focal": (5.0, 5.1, 15.1),
    "sweep-moving": (0.1, 0.11, None),
    "sweep-overlap": (0.95, 0.94, 0.49),
    "sweep-overlay": (5.0, 5.1, None),
    "sweep-points": (100, 99, 29),
    "sweep-registered": (0.8, 0.79, 0.39),
    "sweep-rolling": (0.3, 0.31, None),
    "training-mended": (0, 1, None),
    "views-gain": (1.0, 0.9, None),
    "views-psnr": (18.0, 17.9, 7.9),
}


def remedies(entry: Entry) -> dict[str, str]:
    """Reason -> text."""
    return {"": entry.remedy} if isinstance(entry.remedy, str) else dict(entry.remedy)


def facts(text: str) -> dict[str, float]:
    """Numbers for all that a text names."""
    return {name: 1.5 for _, name, _, _ in string.Formatter().parse(text) if name}


def measured(code: str, value: float | int | str | None, **more: object) -> Measure:
    """A measure with whatever its remedy may ask for."""
    texts = remedies(entries()[code])
    why = next(iter(texts))
    return Measure(code, value, why=why, facts=facts(texts[why]), **more)  # type: ignore[arg-type]


def test_there_are_not_too_many_codes() -> None:
    assert len(entries()) <= MOST_CODES
    assert [code for code in entries() if FORM.fullmatch(code) is None] == []


@pytest.mark.parametrize("code", sorted(BOUNDS))
def test_a_value_at_a_bound_is_fine_and_one_beyond_is_not(code: str) -> None:
    for value, verdict in zip(BOUNDS[code], ("ok", "warn", "fail"), strict=True):
        if value is not None:
            (row,) = judge([measured(code, value)])
            assert (row.verdict, bool(row.remedy)) == (verdict, verdict != "ok")
            (of_test_camera,) = judge(of_test("cam9", [measured(code, value)]))
            assert of_test_camera.verdict == (
                "ok" if BOUNDS[code][1] is None else verdict.replace("fail", "warn")
            )
            assert (of_test_camera.about, of_test_camera.fail) == ("cam9", None)


def test_every_bound_of_the_table_is_tried() -> None:
    tried = {code: tuple(value is not None for value in values[1:]) for code, values in BOUNDS.items()}
    bounds = {code: entry.high or entry.low for code, entry in entries().items()}
    given = {code: tuple(bound is not None for bound in found) for code, found in bounds.items() if found}
    assert tried == {code: found for code, found in given.items() if any(found)}


@pytest.mark.parametrize(
    ("measure", "verdict", "value", "bounds"),
    [
        (Measure("sweep-rolling", None), "warn", None, (0.3, None)),
        (Measure("sweep-rolling", float("nan")), "warn", None, (0.3, None)),
        (Measure("noted", "as it is", found="ok"), "ok", "as it is", (None, None)),
        (Measure("flow-meaning", "x", "cam0", "next", {"whose": ""}, "fail"), "fail", "x", (None, None)),
        (
            Measure("flow-meaning", "x", "", "next", {"whose": ""}, "fail", refuses=False),
            "warn",
            "x",
            (None, None),
        ),
        (Measure("rest-unlike", 20.0, "cam0", warn=21.0), "warn", 20.0, (21.0, None)),
        (Measure("rest-beside", 0.7, "cam0", warn=0.6), "warn", 0.7, (0.6, None)),
        (Measure("rest-beside", 0.6, "cam0", warn=0.6), "ok", 0.6, (0.6, None)),
        (Measure("camera-points", 20, "cam0", fail=12), "warn", 20.0, (100, 12)),
    ],
)
def test_what_is_no_number_and_bounds_that_are_measured(
    measure: Measure, verdict: Verdict, value: object, bounds: tuple[float | None, float | None]
) -> None:
    (row,) = judge([measure])
    assert (row.verdict, row.value, row.warn, row.fail) == (verdict, value, *bounds)
    assert row.remedy.startswith("not measured. ") == (value is None)


def test_a_missing_fact_costs_no_result(caplog: pytest.LogCaptureFixture) -> None:
    (row,) = judge([Measure("sweep-points", 50)])  # its remedy names the pictures
    assert row.verdict == "warn" and "{poor}" in row.remedy and "sweep-points" in caplog.text


def test_the_worst_of_several() -> None:
    found = {"a": 1.0, "b": 3.0, "c": float("nan")}
    assert (highest("x", found, 100).value, highest("x", found).about) == (300.0, "b")
    assert (lowest("x", {"a": 1.0, "b": 3.0}).value, lowest("x", {"a": 1.0, "b": 3.0}).about) == (1.0, "a")
    assert (worst(["ok", "fail", None]), worst(["warn", "ok"]), worst([])) == ("fail", "warn", None)


def codes_of(source: str) -> list[str]:
    """The codes of all measures that a source makes."""
    calls = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Call) and node.args]
    made = [c.args[0] for c in calls if getattr(c.func, "id", "") in ("Measure", "highest", "lowest")]
    return [code.value for code in made if isinstance(code, ast.Constant) and isinstance(code.value, str)]


def test_every_code_is_measured_and_every_measure_has_an_entry() -> None:
    sources = [path.read_text("utf-8") for room in ROOMS for path in (REPOSITORY / room).rglob("*.py")]
    literals = {code for source in sources for code in codes_of(source)}
    assert literals <= entries().keys()
    text = "\n".join(sources)
    assert [code for code in entries() if f'"{code}"' not in text] == []


def texts() -> dict[str, dict[str, str]]:
    """What each code says: what is measured, and what to do by reason, with numbers for what it names."""
    return {
        code: {"check": entry.check, "unit": entry.unit}
        | {
            f"remedy {why}".strip(): text.format(**facts(text))
            for why, text in remedies(entry).items()
            if text
        }
        for code, entry in entries().items()
    }


def test_texts_are_those_that_are_kept() -> None:
    assert texts() == json.loads(TEXTS.read_text("utf-8")), (
        "if that is intended: python -m tests.pipelines.test_health"
    )


if __name__ == "__main__":
    TEXTS.write_text(json.dumps(texts(), indent=1, ensure_ascii=False) + "\n", "utf-8")
