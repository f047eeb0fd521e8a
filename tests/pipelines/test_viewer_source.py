# ruff: noqa: F811 (fixtures are arguments)
"""What a run folder has to show while it fills, and what the viewer says of it."""

import json
import os
import socket
import time
from pathlib import Path

import numpy as np
import pytest
from tests.pipelines.viewer_run import ViewerRun
from tests.reconstruct.conftest import Ball, ball, rest  # noqa: F401 (fixtures)
from tests.refused import refused
from tests.waiting import wait_for

from devrf.pipelines.config.load import load_scene
from devrf.pipelines.run_folder.lock import LEASE_S, Lock, is_held
from devrf.pipelines.viewer.own_address import Address
from devrf.pipelines.viewer.run_status import standing
from devrf.pipelines.viewer.server import Site
from devrf.pipelines.viewer.source import Loaded, RunVersions, load, look, progress
from devrf.reconstruct.fields.canonical_model import RestModel
from devrf.reconstruct.rendering.model import render_view


@pytest.fixture
def run(tmp_path: Path) -> ViewerRun:
    return ViewerRun(tmp_path)


def told(run: ViewerRun, loaded: Loaded) -> str:
    return standing(load_scene(run.scene_yaml, check_files=False), run.run_dir, loaded)


def test_what_is_shown_follows_the_run(run: ViewerRun, ball: Ball, rest: RestModel) -> None:
    def now() -> Loaded:
        return load(run.run_dir, look(run.run_dir), "cpu")

    assert look(run.run_dir) == RunVersions() and now().scene is None
    assert "nothing to show yet" in told(run, now()) and "no run at work" in told(run, now())
    run.scene(ball.scene)
    loaded = now()
    assert loaded.scene is not None and loaded.model is None
    assert "cameras and points, no model yet" in told(run, loaded)
    run.rest_in_training(rest)
    loaded = now()
    assert loaded.model is not None and loaded.model.motion is None
    assert "interrupted" in told(run, loaded)
    camera = ball.scene.static[0].camera
    expected = render_view(loaded.model, camera, None)
    run.rest(rest)
    loaded = now()
    assert loaded.found.training is None and loaded.model is not None
    assert np.abs(render_view(loaded.model, camera, None) - expected).max() < 0.05  # packed in bytes
    run.motion(rest)
    loaded = now()
    assert loaded.model is not None and loaded.model.motion is not None
    assert "finished model" in told(run, loaded)


def test_a_training_shows_only_while_a_run_is_at_work(run: ViewerRun, ball: Ball, rest: RestModel) -> None:
    run.scene(ball.scene)
    run.rest(rest)
    run.motion(rest)
    run.rest_in_training(rest)
    found = look(run.run_dir)
    assert found.training is None and found.motion is not None  # one that was given up
    lock = Lock(run.run_dir)
    lock.take()
    try:
        found = look(run.run_dir)
        assert found.training is not None and found.training[0] == "canonical" and found.motion is None
        events = [
            {"event": "stage_started", "stage": "canonical"},
            {"event": "progress", "stage": "canonical", "fraction": 0.25, "text": "PSNR <20> dB"},
        ]
        lines = "".join(json.dumps(event) + "\n" for event in events)
        (run.run_dir / "events.jsonl").write_text("x" * 5000 + "\n" + lines + '{"half')
        said = told(run, load(run.run_dir, found, "cpu"))
        assert "run at work" in said and "canonical 25 %: PSNR &lt;20&gt; dB" in said
        assert "<b>in training" in said
    finally:
        lock.release()
    assert look(run.run_dir).training is None
    (run.run_dir / "events.jsonl").write_text('{"event": "run_finished"}\n')
    assert progress(run.run_dir) == {}


def test_a_motion_of_another_scene_at_rest_is_not_shown(run: ViewerRun, ball: Ball, rest: RestModel) -> None:
    run.scene(ball.scene)
    run.rest(rest)
    run.motion(rest, made_of="something else")
    assert look(run.run_dir).motion is None
    model = load(run.run_dir, look(run.run_dir), "cpu").model
    assert model is not None and model.motion is None


def test_what_is_damaged_is_named(run: ViewerRun, ball: Ball, rest: RestModel) -> None:
    run.scene(ball.scene)
    run.rest(rest)
    (run.run_dir / "canonical/model.safetensors").write_bytes(b"half")
    with refused("file-damaged", "model.safetensors"):
        load(run.run_dir, look(run.run_dir), "cpu")
    (run.run_dir / "scene/scene.json").write_text("{")
    with refused("file-damaged", run.run_dir / "scene" / "scene.json"):
        load(run.run_dir, look(run.run_dir), "cpu")


def test_what_is_not_well_is_said(run: ViewerRun, ball: Ball, rest: RestModel) -> None:
    run.scene(ball.scene)
    run.rest(rest)
    loaded = load(run.run_dir, look(run.run_dir), "cpu")
    said = told(run, loaded)
    assert "not finished" in said and "deformation, evaluate" in said and "ball &lt;b&gt;" in said
    assert "healthy" not in said
    run.health("scene", "warn", "rays that miss")
    assert "doubtful" in told(run, loaded) and "warnings: 1 in 1 checks" in told(run, loaded)
    run.health("canonical", "fail", "PSNR <i>")
    said = told(run, loaded)
    assert "unhealthy" in said and "refused the result: 1" in said and "Film it again." in said
    assert "<b>canonical</b>: PSNR &lt;i&gt;" in said and "rays that miss" not in said
    (run.run_dir / ".failed-deformation.json").write_text('{"message": "no room", "code": 1}')
    assert "deformation failed" in told(run, loaded) and "no room" in told(run, loaded)


def test_a_lock_is_looked_at_and_not_taken(tmp_path: Path) -> None:
    assert not is_held(tmp_path)
    lock = Lock(tmp_path)
    lock.take()
    assert is_held(tmp_path)
    lock.check()
    lock.release()
    assert not is_held(tmp_path)
    dead = {"pid": 1, "host": "another", "boot": "b", "pids": "p", "since": "then"}
    (tmp_path / ".lock").write_text(json.dumps(dead))
    assert is_held(tmp_path)  # of another machine, touched just now
    old = time.time() - LEASE_S - 1
    os.utime(tmp_path / ".lock", (old, old))
    assert not is_held(tmp_path)


def test_a_damaged_model_is_shown_as_such_until_it_is_replaced(
    run: ViewerRun, ball: Ball, rest: RestModel
) -> None:
    run.scene(ball.scene)
    run.rest(rest)
    (run.run_dir / "canonical/model.safetensors").write_bytes(b"half")
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    at = Address("127.0.0.1", port)
    site = Site(load_scene(run.scene_yaml, check_files=False), run.run_dir, "cpu", at)
    try:
        assert site.loaded.scene is not None and site.loaded.model is None
        assert "not readable" in site.standing() and "model.safetensors" in site.standing()
        run.rest_in_training(rest)
        lock = Lock(run.run_dir)
        lock.take()
        wait_for(lambda: site.loaded.model is not None)
        said = site.standing()
        lock.release()
        assert "not readable" not in said and "in training" in said
    finally:
        site.close()
