"""`view` as a command: what it refuses, that it only reads, that it ends at once."""

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from tests.make.models import random_model
from tests.pipelines.viewer_run import ViewerRun
from tests.waiting import wait_for

from devrf.capture.scene import Scene
from devrf.pipelines.viewer.own_address import refusal


@pytest.fixture
def taken() -> Iterator[int]:
    """A port that another program listens on."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield server.getsockname()[1]


def test_bad_input_is_told_before_anything_starts(devrf: Callable, tmp_path: Path, taken: int) -> None:
    run = ViewerRun(tmp_path)
    busy = devrf("view", run.scene_yaml, "--port", str(taken))
    assert busy.code == 2 and f"--port {taken}: " in busy.err and "[port-unusable]" in busy.err
    other = int(busy.err.split("--port ")[-1].split()[0])
    assert other != taken
    with socket.create_server(("127.0.0.1", other)):
        pass  # it is free
    elsewhere = devrf("view", run.scene_yaml, "--host", "192.0.2.1")
    assert elsewhere.code == 2 and "--host 192.0.2.1: " in elsewhere.err
    assert "[host-elsewhere]" in elsewhere.err
    device = devrf("view", run.scene_yaml, "--port", str(other), "--device", "gpu")
    assert device.code == 2 and "--device gpu: " in device.err and "[option-unknown-value]" in device.err
    run.run_dir.rmdir()
    nothing = devrf("view", run.scene_yaml)
    assert nothing.code == 2 and str(run.run_dir) in nothing.err and "[run-missing]" in nothing.err


def test_without_viser_it_says_how_to_get_it(tmp_path: Path) -> None:
    run = ViewerRun(tmp_path)
    (tmp_path / "viser.py").write_text("raise ModuleNotFoundError('no viser', name='viser')")
    result = subprocess.run(
        [sys.executable, "-m", "devrf.pipelines.cli.main", "view", str(run.scene_yaml)],
        capture_output=True, text=True, timeout=60, env=os.environ | {"PYTHONPATH": str(tmp_path)},
    )  # fmt: skip
    assert result.returncode == 2
    assert "(viser " in result.stderr and "[package-missing]" in result.stderr
    assert "python -m pip install -e '.[viewer]'" in result.stderr


@pytest.mark.parametrize("sign", [pytest.param(signal.SIGINT, marks=pytest.mark.full), signal.SIGTERM])
def test_it_reads_only_and_ends_at_once(odd_scene: Scene, tmp_path: Path, sign: signal.Signals) -> None:
    run = ViewerRun(tmp_path)
    run.scene(odd_scene)
    run.rest(random_model().rest)
    before = _tree(run.run_dir)
    host = "0.0.0.0" if sign == signal.SIGTERM else "127.0.0.1"
    command = [sys.executable, "-u", "-m", "devrf.pipelines.cli.main", "view", str(run.scene_yaml)]
    with socket.create_server((host, 0)) as probe:
        port = probe.getsockname()[1]
    out = tmp_path / "said"
    with out.open("w") as file:
        process = subprocess.Popen(
            [*command, "--host", host, "--port", str(port)], stdout=file, stderr=subprocess.STDOUT,
            env=os.environ | {"WARP_CACHE_PATH": str(tmp_path / "kernels")},  # compiled while it is to end
        )  # fmt: skip
        wait_for(lambda: "Ctrl-C ends it" in out.read_text(), process=process)
        with socket.create_connection(("127.0.0.1", port), timeout=10) as page:
            page.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n")
            assert b"200 OK" in page.recv(1000)
        for asked in (b"Host: evil.example", b"Host: localhost\r\nOrigin: http://evil.example"):
            with socket.create_connection(("127.0.0.1", port), timeout=10) as page:
                page.sendall(
                    b"GET / HTTP/1.1\r\nConnection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\n"
                    b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n" + asked + b"\r\n\r\n"
                )
                assert b"403 Forbidden" in page.recv(1000)
        told = time.monotonic()
        process.send_signal(sign)
        assert process.wait(timeout=30) == 130
    assert time.monotonic() - told < 10  # at once, on a busy machine too
    said = out.read_text()
    assert ("nobody is asked for a password" in " ".join(said.split())) == (host == "0.0.0.0")
    assert said.count("\n") == 1 + (host == "0.0.0.0") and "Traceback" not in said
    assert _tree(run.run_dir) == before


@pytest.mark.parametrize(
    ("host", "origin", "served"),
    [
        ("localhost:8080", None, True),
        ("127.0.0.1:9000", "http://127.0.0.1:9000", True),  # through a tunnel
        ("[::1]:8080", "http://[::1]:8080", True),
        (f"{socket.gethostname()}:8080", None, True),
        ("scenes.example", "https://scenes.example", True),
        ("localhost:8080", "https://scenes.example", True),  # a proxy that names itself
        ("evil.example:8080", None, False),
        ("localhost.evil.example", None, False),
        ("localhost:8080", "http://evil.example", False),
        ("localhost:8080", "http://localhost:3000", False),
        ("localhost:8080", "null", False),
        ("localhost:8080", "http://[", False),  # no address at all
        ("[", None, False),
        ("", None, False),
        (None, None, False),
    ],
)
def test_only_its_own_pages_are_served(host: str | None, origin: str | None, served: bool) -> None:
    assert (refusal(host, origin, ["Scenes.example"]) is None) == served


def _tree(folder: Path) -> list[tuple[str, int, int]]:
    status = [(path, path.stat()) for path in sorted(folder.rglob("*"))]
    return [(str(path), s.st_size, s.st_mtime_ns) for path, s in status]
