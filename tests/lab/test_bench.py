"""The benchmarks through the command line, on a data set of 32 x 32 pictures."""

import inspect
import json
import shutil
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from tests.lab.conftest import SETTINGS

from devrf.lab.bench.bench_rows import Row
from devrf.lab.bench.training.ablation import PAPER_FORWARD, PAPER_INWARD
from devrf.lab.bench.training.ablation_variants import VARIANTS, ablated
from devrf.lab.bench.training.measured import Measured, pareto
from devrf.reconstruct.options import PRESETS

REPOSITORY = Path(__file__).resolve().parents[2]
PICTURES = {"width": 32, "static": 14, "cameras": 2, "times": 3}
ABSENT = ("cv2", "av", "pycolmap", "viser", "rawpy", "mitsuba", "ray")
KEYS = {"name", "value", "unit", "anchor", "goal", "met"}  # the contract's


@pytest.fixture(scope="module")
def ablation(devrf: Any, arm: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    out = tmp_path_factory.mktemp("ablation")
    return out, _bench(devrf, "ablation", arm, "--out", str(out), "--seeds", "2", *SETTINGS)


def _bench(devrf: Any, name: str, scene: Path, *arguments: str, code: int = 0) -> str:
    """Output of a benchmark that has to end with an exit code."""
    done = devrf("bench", name, scene, "--preset", "reference", "--device", "cpu", *arguments)
    assert done.code == code, done.said[-2000:]
    return done.said


def _rows(path: Path) -> dict[str, dict]:
    content = json.loads(path.read_text())
    assert all(row.keys() >= KEYS for row in content["rows"])
    assert content["device"].startswith("CPU")
    assert {k: content["pictures"][k] for k in ("width", "static", "cameras", "times")} == PICTURES
    return {row["name"]: row for row in content["rows"]}


@pytest.mark.full
def test_ablation_measures_every_variant_beside_the_paper(ablation: tuple[Path, str]) -> None:
    out, _ = ablation
    rows = _rows(out / "ablation.json")
    for name in VARIANTS:
        row = rows[f"ablation/{name}/test/psnr"]
        assert 5 < row["value"] < 60 and row["spread"] >= 0
        assert row["anchor"] == PAPER_INWARD[name]["psnr"] and "other data" in row["source"]
    gain = rows["ablation/base to c2f/psnr"]
    difference = rows["ablation/c2f/test/psnr"]["value"] - rows["ablation/base/test/psnr"]["value"]
    assert gain["value"] == pytest.approx(difference) and gain["goal"] == 2.0
    assert gain["met"] == (difference >= 2.0)
    lpips = rows["ablation/flow/test/lpips_vgg"]
    assert lpips["value"] is None and "no LPIPS weights" in lpips["why"]
    assert (out / "ablation.png").stat().st_size > 10_000


@pytest.mark.full
def test_nothing_is_trained_twice(devrf: Any, ablation: tuple[Path, str], arm: Path) -> None:
    out, _ = ablation
    files = sorted(out.glob("seed*/*/metrics.json"))
    before = {file: file.stat().st_mtime_ns for file in files}
    assert len(before) == 2 * (1 + len(VARIANTS))
    output = _bench(devrf, "ablation", arm, "--out", str(out), "--seeds", "2", *SETTINGS)
    assert "nothing changed" in output
    assert before == {file: file.stat().st_mtime_ns for file in files}


def test_rows_that_cannot_be_written_are_refused_before_training(
    devrf: Any, arm: Path, tmp_path: Path
) -> None:
    (tmp_path / "file").touch()
    for path in (tmp_path, tmp_path / "file" / "rows.json"):
        said = _bench(devrf, "views", arm, "--out", str(tmp_path / "o"), "--json", str(path), code=2)
        assert f"--json {path}" in said or f"--json {path.parent}" in said
    said = _bench(devrf, "views", arm, "--out", str(tmp_path / "file"), code=2)
    assert f"--out {tmp_path / 'file'}: " in said and "[folder-unwritable]" in said
    assert not (tmp_path / "o").exists()


@pytest.mark.full
def test_the_table_is_whole_in_a_pipe(ablation: tuple[Path, str]) -> None:
    _, said = ablation
    assert "…" not in said
    assert "ablation/cycle/test_moving/psnr" in said and "not measured" in said


@pytest.mark.full
def test_some_variants_only(devrf: Any, arm: Path, ablation: tuple[Path, str], tmp_path: Path) -> None:
    out, _ = ablation
    _bench(
        devrf, "ablation", arm, "--out", str(out), "--only", "base,+tv", "--json", str(tmp_path / "few.json"),
        *SETTINGS,
    )  # fmt: skip
    names = {name.split("/")[1] for name in _rows(tmp_path / "few.json")}
    assert names == {"base", "tv", "base to tv"}
    wrong = _bench(devrf, "ablation", arm, "--only", "tvv", *SETTINGS, code=2)
    assert "tvv" in wrong and "c2f" in wrong


def test_nothing_is_rendered_for_words_that_are_wrong(devrf: Any, tmp_path: Path) -> None:
    done = devrf("bench", "stability", "--out", str(tmp_path / "o"), "--device", "tpu")
    assert done.code == 2 and "tpu" in done.said and "cuda" in done.said
    assert not (tmp_path / "o").exists()


@pytest.mark.full
def test_views_go_from_one_camera_to_all(devrf: Any, arm: Path, tmp_path: Path) -> None:
    _bench(devrf, "views", arm, "--out", str(tmp_path), *SETTINGS)
    rows = _rows(tmp_path / "views.json")
    assert {name.split("/")[1] for name in rows} == {"1", "2"}
    one, two = (rows[f"views/{n}/test/psnr"]["value"] for n in (1, 2))
    assert one != two
    assert (tmp_path / "views.png").is_file()


@pytest.mark.full
def test_speed_draws_accuracy_against_cost(devrf: Any, arm: Path, tmp_path: Path) -> None:
    choice = ("--presets", "fast,reference", "--efforts", "0.5,1", "--every", "0.3")
    choice += ("--set-for", "reference:reconstruct.key_times=2")
    said = _bench(devrf, "speed", arm, "--out", str(tmp_path), *choice, *SETTINGS)
    rows = _rows(tmp_path / "speed.json")
    for name in ("fast x0.5", "fast", "reference x0.5", "reference"):
        assert 5 < rows[f"speed/{name}/test/psnr"]["value"] < 60
        for cost in ("seconds", "megabytes", "render_fps"):
            assert rows[f"speed/{name}/{cost}"]["value"] > 0
    share = rows["speed/fast of reference/seconds"]
    expected = rows["speed/fast/seconds"]["value"] / rows["speed/reference/seconds"]["value"]
    assert share["value"] == pytest.approx(expected) and share["goal"] == 1 / 8
    assert share["met"] == (expected <= 1 / 8)
    content = json.loads((tmp_path / "speed.json").read_text())
    assert content["set"]["reference"]["key_times"] == 2 and "key_times" not in content["set"]["fast"]
    for name, curve in content["curves"].items():
        seconds = [look["seconds"] for look in curve]
        assert len(curve) >= 2 and seconds == sorted(seconds)
        assert seconds[-1] <= rows[f"speed/{name}/seconds"]["value"] + 0.01  # looks are off the clock
    assert set(content["front"]) == {"seconds", "megabytes", "fps"} and "not beaten" in said
    assert all("synthetic" in row["on"] for row in content["published"])
    assert (tmp_path / "speed.png").stat().st_size > 20_000


@pytest.mark.parametrize(
    ("option", "value", "refusal", "named"),
    [
        ("--presets", "fats", "option-unknown-value", "fats"),
        ("--efforts", "0", "option-malformed", "0"),
        ("--efforts", "half", "option-malformed", "half"),
        ("--set-for", "fast:rays=3", "option-malformed", "fast:rays=3"),
        ("--set-for", "slow:reconstruct.rays=3", "option-malformed", "slow:reconstruct.rays=3"),
        ("--set-for", "fast:reconstruct.rays=many", "configuration", "reconstruct.rays"),
    ],
)
def test_speed_names_wrong_words(
    devrf: Any, arm: Path, option: str, value: str, refusal: str, named: str
) -> None:
    said = _bench(devrf, "speed", arm, option, value, *SETTINGS, code=2)
    assert named in said and f"[{refusal}]" in said


def test_a_front_holds_what_no_other_beats() -> None:
    def measured(name: str, psnr: float, seconds: float, fps: float) -> Measured:
        result = {"test": {"psnr": psnr}, "model_mb": 1.0, "render_fps": fps}
        return Measured(name, result, [], seconds)

    found = [
        measured("slow and good", 30.0, 100.0, 1.0),
        measured("quick", 28.0, 10.0, 2.0),
        measured("beaten", 27.0, 20.0, 1.5),
        measured("quickest", 20.0, 5.0, 1.9),
        measured("as quick, worse", 19.0, 5.0, 1.0),
    ]
    assert [one.name for one in pareto(found, "seconds")] == ["slow and good", "quick", "quickest"]
    assert [one.name for one in pareto(found, "fps")] == ["slow and good", "quick"]
    assert [one.name for one in pareto(found, "megabytes")] == ["slow and good"]


@pytest.mark.full
def test_the_gpu_script_measures_speed_and_ablation(arm: Path, tmp_path: Path) -> None:
    """benchmarks/gpu.sh as a user calls it, on the CPU at a small size, where no vision or video library is."""
    script = tmp_path / "repository" / "benchmarks"
    shutil.copytree(REPOSITORY / "benchmarks", script)
    (tmp_path / "sitecustomize.py").write_text(
        f"import sys\nfor name in {ABSENT!r}: sys.modules[name] = None\n"
    )
    env = {
        "PATH": "/usr/bin:/bin",
        "PYTHON": sys.executable,
        "PYTHONPATH": str(tmp_path),
        "RESULTS": str(tmp_path / "results"),
    }
    blocked = subprocess.run([sys.executable, "-c", "import cv2"], env=env, capture_output=True, check=False)
    assert blocked.returncode != 0  # they are really out of reach
    settings = SETTINGS[: SETTINGS.index("reconstruct.image_scale=1.0") - 1]  # the script says which share
    command = [script / "gpu.sh", arm, "--device", "cpu", *settings]
    done = subprocess.run(command, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    speed = _rows(tmp_path / "results" / "speed-arm.json")
    assert speed["speed/reference/test/psnr"]["value"] > 5
    assert 0 < speed["speed/fast of reference/seconds"]["value"]
    content = json.loads((tmp_path / "results" / "ablation-arm.json").read_text())
    ablation = {row["name"]: row for row in content["rows"]}
    assert all(ablation[f"ablation/{name}/test/psnr"]["value"] > 5 for name in VARIANTS)
    assert content["pictures"]["width"] == 16  # of 32


def test_a_scene_at_rest_is_refused(devrf: Any, tmp_path: Path, data_dir: Path) -> None:
    scene = tmp_path / "scene.yaml"
    scene.write_text(f"name: fox\ncapture: {{static: {data_dir / 'fox_static' / 'images'}}}\n")
    assert "moving" in _bench(devrf, "ablation", scene, code=2)


def test_ablation_takes_parts_away_and_nothing_else() -> None:
    full = PRESETS["reference"].motion
    variants = ablated(full, full)
    assert tuple(variants) == VARIANTS == tuple(PAPER_INWARD) == tuple(PAPER_FORWARD)
    assert variants["flow"] == full
    assert sum(variants["base"].iterations) == sum(full.iterations) and len(variants["base"].levels) == 1
    assert variants["base"].levels[0] == full.levels[-1]
    weights = {name: (o.variation > 0, o.cycle > 0, o.flow > 0) for name, o in variants.items()}
    assert weights["c2f"] == (False, False, False) and weights["tv"] == (True, False, False)
    assert weights["cycle"] == (True, True, False)


@pytest.mark.parametrize(
    ("name", "levels"),
    [
        ("tiny", (7, 14, 28, 56, 112)),
        ("fast", (10, 20, 40, 80, 160)),
        ("reference", (10, 20, 40, 80, 160)),
    ],
)
def test_ablation_is_of_fields_with_the_published_pyramid(name: str, levels: tuple[int, ...]) -> None:
    options, published = PRESETS[name].motion, PRESETS["reference"].motion
    for variant in ablated(options, published).values():
        assert variant.together == 0 and variant.fine_tuning == 0
        assert sum(variant.iterations) == sum(published.iterations) and variant.levels[-1] == levels[-1]
        assert (variant.lr, variant.importance, variant.rays) == (
            options.lr,
            options.importance,
            options.rays,
        )
    assert ablated(options, published)["flow"].levels == levels


def test_rows_are_judged_against_goals() -> None:
    assert Row("a", 2.0, "dB").at_least(2.0).met is True
    assert Row("a", 1.9, "dB").at_least(2.0).met is False
    assert Row("a", 0.1, "").at_most(0.2).met is True
    assert Row("a", None, "").at_least(1.0).met is None
    assert Row("a", 0.1, "").at_most(None) == Row("a", 0.1, "")


def test_every_part_is_there() -> None:
    """Parts are named by module for commands that start quickly; each is a function of one argument."""
    from devrf.lab.bench.accuracy.accuracy_commands import ACCURACY

    for _, parts in ACCURACY.values():
        for name, module in parts.items():
            part = getattr(import_module(f"devrf.lab.bench.accuracy.{module}"), name)
            assert list(inspect.signature(part).parameters) == ["cases"]
