"""A motion model of an installed package in stage 2: that of docs/extending.md, on a ball whose way is known."""

from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
from tests.docs.pages import REPOSITORY, blocks
from tests.make.models import AABB, TRAVEL, moving_ball
from tests.make.scenes import scene_of
from tests.reconstruct.conftest import around, look_at

from devrf.capture.scene import PosedFrame, Scene
from devrf.capture.system.errors import InputError, ReconstructError
from devrf.capture.system.progress import no_progress
from devrf.reconstruct.options import preset
from devrf.reconstruct.rendering.model import moments_of, render_view
from devrf.reconstruct.training import own_motion
from devrf.reconstruct.training.own_motion import fit_own

OPTIONS = replace(preset("tiny").motion, keys=3, levels=(8,), iterations=(1,))


@pytest.fixture(scope="module")
def clips(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """Two fixed cameras of the ball that goes along x."""
    folder, model, frames = tmp_path_factory.mktemp("clips"), moving_ball(resolution=20), []
    for c, eye in enumerate(around(2, 0.4, 0.3)):
        camera = look_at(eye)
        for n in range(3):
            path = folder / f"{c}_{n}.png"
            cv2.imwrite(str(path), (255 * render_view(model, camera, n / 2)[..., ::-1]).round())
            frames.append(PosedFrame(path, camera, f"cam{c}", n, n / 2, n / 2, "train"))
    return scene_of((), frames, aabb=AABB.double().numpy(), near=0.3, far=9.0, background="white")


def adds(patch: pytest.MonkeyPatch, create: object) -> None:
    """An installed package adds `mine`."""
    patch.setattr(
        own_motion, "installed", lambda group: {"mine": SimpleNamespace(value="a:b", load=lambda: create)}
    )


def test_the_model_of_the_page_finds_the_velocity(clips: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    (code,) = (b.text for b in blocks(REPOSITORY / "docs" / "extending.md") if b.file == "drift/drift.py")
    names: dict = {}
    exec(code, names)
    adds(monkeypatch, names["create"])
    rest = moving_ball(resolution=20).rest
    model, metrics = fit_own("mine", clips, rest, {}, OPTIONS, no_progress)
    assert model.motion is not None and model.motion.key_times == [0.0, 0.5, 1.0] == moments_of(model)
    ways = model.motion.forward[:, 0, 0, 0].numpy()
    np.testing.assert_allclose(ways, np.outer([0, 0.5, 1], [TRAVEL, 0, 0]), atol=1e-6)
    assert metrics["keys"] == 3 and metrics["pictures"] == 6 and metrics["rate"] == 1
    assert metrics["largest_motion"] == pytest.approx(TRAVEL, abs=1e-6)


class _Wrong:
    def fit(self, scene, rest, flows, motion, progress):  # noqa: ANN001, ANN201
        motion.backward[1, 0, 0, 0, 0] = torch.nan
        return motion


def _no_model(device: str) -> None:
    raise RuntimeError("no weights")


@pytest.mark.parametrize(
    ("create", "kind", "code"),
    [
        (lambda device: _Wrong(), ReconstructError, "estimator-result-wrong"),
        (_no_model, InputError, "method-unusable"),
    ],
)
def test_a_model_that_cannot_be_used_is_named(
    create: object, kind: type, code: str, clips: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    adds(monkeypatch, create)
    with pytest.raises(kind) as error:
        fit_own("mine", clips, moving_ball(resolution=20).rest, {}, OPTIONS, no_progress)
    assert error.value.code == code and "mine" in str(error.value)
