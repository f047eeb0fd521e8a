"""A training that was killed, wherever that was, ends with bit for bit the same model and metrics."""

import pickle
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from tests.reconstruct.conftest import REST
from tests.reconstruct.deaths import until_done
from torch import Tensor

from devrf.capture.scene import Scene
from devrf.capture.system.errors import OutOfTime
from devrf.reconstruct import recipe
from devrf.reconstruct.fields.canonical_model import RestModel
from devrf.reconstruct.options import CanonicalOptions, MotionOptions
from devrf.reconstruct.storage.checkpoint import Checkpoint
from devrf.reconstruct.training import fine_tune as fine_tuning
from devrf.reconstruct.training import train_motion as motion_training
from devrf.reconstruct.training.loop import TrainingRun
from devrf.reconstruct.training.train_canonical import train_canonical

SHORT = replace(
    REST,
    iterations=24,
    occupancy_every=5,
    shell_resolution=24,
    coarse_rays=256,
    coarse_size=24,
    variation=1e-4,
)  # it grows at iterations 6 and 12
MOTION = MotionOptions(
    levels=(4, 6), iterations=(5, 3), rays=300, importance=0.7, lr=6e-3, most_keys=4, weight_threshold=1e-3,
    adapt=False, fine_tuning=8,
)  # fmt: skip


@pytest.fixture(autouse=True)
def often(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is done every few iterations is done within these trainings too."""
    monkeypatch.setattr(fine_tuning, "WINDOW_EVERY", 3)
    monkeypatch.setattr(motion_training, "LIVE_EVERY", 3)


TIMES = ("seconds", "rays_per_s", "peak_rss_gb", "fine_tuning_s")


def _tensors(rest: RestModel) -> dict[str, Tensor]:
    """All of a scene at rest."""
    canonical = rest.canonical
    out = {name: getattr(canonical, name) for name in ("density", "features", "distance", "aabb")}
    out |= canonical.net.state_dict()
    if rest.shell is not None:
        out |= {"shell": rest.shell.grid, "shell distance": rest.shell.distance}
    return out


def _assert_same(a: dict[str, Tensor], b: dict[str, Tensor]) -> None:
    assert a.keys() == b.keys()
    for name in a:
        assert torch.equal(a[name], b[name]), name


def _timeless(metrics: dict[str, Any]) -> dict[str, Any]:
    kept = {name: value for name, value in metrics.items() if name not in TIMES}
    kept["curve"] = [{k: v for k, v in row.items() if k != "seconds"} for row in metrics["curve"]]
    return kept


def _assert_same_rest(scene: Scene, options: CanonicalOptions, folder: Path, deaths: set) -> None:
    undisturbed = train_canonical(scene, options)
    resumed = until_done(
        lambda state: train_canonical(scene, options, run=TrainingRun(checkpoint=state)), folder, deaths
    )
    _assert_same(_tensors(undisturbed), _tensors(resumed))
    assert _timeless(undisturbed.metrics) == _timeless(resumed.metrics)


@pytest.mark.parametrize("deferred", [pytest.param(False, marks=pytest.mark.full), True])
def test_scene_at_rest(ball, tmp_path: Path, deferred: bool) -> None:
    """In the middle of every resolution, right before the grids grow, right after, and after the last step."""
    deaths = {("", done) for done in (1, 6, 7, 12, 13, 17, 24)}
    _assert_same_rest(ball.scene, replace(SHORT, deferred=deferred), tmp_path, deaths)


@pytest.mark.full
def test_search_of_the_box_by_a_coarse_model(ball, tmp_path: Path) -> None:
    options = replace(SHORT, box_search="coarse", coarse_iterations=350, coarse_rays=512)
    deaths = {("box", done) for done in (1, 100, 249, 350)} | {("", 3), ("", 20)}
    _assert_same_rest(ball.scene, options, tmp_path, deaths)


@pytest.mark.full
def test_surroundings(ball, tmp_path: Path) -> None:
    """The coarse model of everything grows three times, by a quarter of its iterations."""
    scene = replace(ball.scene, background="shell", aabb=np.array([[-0.7] * 3, [0.7] * 3]), far=8.0)
    deaths = {("coarse", done) for done in (1, 6, 7, 20, 24)} | {("", 2), ("", 6), ("", 23)}
    _assert_same_rest(scene, replace(SHORT, coarse_iterations=24), tmp_path, deaths)


@pytest.mark.full
@pytest.mark.parametrize("windows", [None, [(0, 1), (1, 3)]], ids=["at once", "in parts"])
def test_motion_and_fine_tuning(
    ball, rest: RestModel, tmp_path: Path, windows: list | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    if windows is not None:
        monkeypatch.setattr(fine_tuning, "_windows", lambda motion, device: windows)

    def train(state: Checkpoint):
        return recipe.motion(ball.scene, rest, {}, MOTION, run=TrainingRun(checkpoint=state))

    model, metrics = recipe.motion(ball.scene, rest, {}, MOTION)
    deaths = {("", done) for done in (1, 3, 5, 6)} | {("fine-tuning", done) for done in (1, 4, 6, 8)}
    again, metrics_again = until_done(train, tmp_path, deaths)
    assert model.motion is not None and again.motion is not None
    assert torch.equal(model.motion.backward, again.motion.backward)
    assert torch.equal(model.motion.forward, again.motion.forward)
    assert model.in_motion is not None and again.in_motion is not None
    _assert_same(_tensors(model.in_motion), _tensors(again.in_motion))
    assert _timeless(metrics) == _timeless(metrics_again)


@pytest.mark.full
def test_without_time_it_does_a_step_and_goes_on(ball, tmp_path: Path) -> None:
    options = replace(SHORT, iterations=6)
    undisturbed = train_canonical(ball.scene, options)
    stops = 0
    while True:
        try:
            state = Checkpoint(tmp_path / "state", "this training", until=time.monotonic())
            resumed = train_canonical(ball.scene, options, run=TrainingRun(checkpoint=state))
        except OutOfTime as error:
            stops += 1
            assert error.code == "out-of-time" and f"step {stops} of 6" in str(error)
            continue
        break
    assert stops == options.iterations - 1  # after the last one it is done
    _assert_same(_tensors(undisturbed), _tensors(resumed))
    assert _timeless(undisturbed.metrics) == _timeless(resumed.metrics)


def _cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def _flip(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[-len(content) // 3] ^= 1
    path.write_bytes(content)


def _hole(path: Path) -> None:
    """As a power cut leaves it, where the disk had the length, not yet all of the content."""
    content = bytearray(path.read_bytes())
    content[len(content) // 2 :] = bytes(len(content) - len(content) // 2)
    path.write_bytes(content)


@pytest.mark.parametrize("damage", [_cut, _flip, _hole])
def test_damaged_checkpoint_means_to_begin_anew(
    ball, tmp_path: Path, damage: Callable[[Path], None], caplog: pytest.LogCaptureFixture
) -> None:
    options = replace(SHORT, iterations=8)
    state = Checkpoint(tmp_path / "state", "this training", every_s=0.0)
    undisturbed = train_canonical(ball.scene, options, run=TrainingRun(checkpoint=state))
    damage(tmp_path / "state")
    resumed = train_canonical(
        ball.scene, options, run=TrainingRun(checkpoint=Checkpoint(tmp_path / "state", "this training"))
    )
    (said,) = (record for record in caplog.records if record.levelname == "WARNING")
    assert str(tmp_path / "state") in said.getMessage()
    _assert_same(_tensors(undisturbed), _tensors(resumed))
    assert _timeless(undisturbed.metrics) == _timeless(resumed.metrics)


TRAINING = """
import pickle, sys
from pathlib import Path
from safetensors.torch import save_file
from tests.reconstruct.test_resuming import SHORT, _tensors
from devrf.reconstruct.storage.checkpoint import Checkpoint
from devrf.reconstruct.training.loop import TrainingRun
from devrf.reconstruct.training.train_canonical import train_canonical

scene, folder = pickle.loads(Path(sys.argv[1]).read_bytes()), Path(sys.argv[2])
state = Checkpoint(folder / "state", "this training", every_s=0.0)
model = train_canonical(scene, SHORT, run=TrainingRun(checkpoint=state))
save_file(_tensors(model), folder / "model")
"""


@pytest.mark.full
def test_killed_by_the_system(ball, tmp_path: Path) -> None:
    """SIGKILL, at whatever the process is doing after its first checkpoint."""
    (tmp_path / "scene").write_bytes(pickle.dumps(ball.scene))
    command = [sys.executable, "-c", TRAINING, str(tmp_path / "scene"), str(tmp_path)]
    root = Path(__file__).resolve().parents[2]
    with subprocess.Popen(command, cwd=root) as process:
        while not (tmp_path / "state").exists() and process.poll() is None:
            time.sleep(0.01)
        time.sleep(0.05)
        process.kill()
    assert process.returncode == -signal.SIGKILL and not (tmp_path / "model").exists()
    subprocess.run(command, cwd=root, check=True, timeout=300)
    _assert_same(_tensors(train_canonical(ball.scene, SHORT)), load_file(tmp_path / "model"))
