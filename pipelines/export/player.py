"""Export of the player: one HTML page that carries the scene in motion (docs/player.md)."""

from typing import TYPE_CHECKING, Any

import numpy as np

from devrf.capture.camera import Camera
from devrf.capture.system.errors import InputError
from devrf.capture.system.progress import part
from devrf.pipelines.export import splat_options as shared
from devrf.pipelines.export.request import Request
from devrf.pipelines.export.trained import ExportedModel
from devrf.pipelines.player.page import page_size, player_page
from devrf.reconstruct.geometry.camera_arc import Span, film_cameras, film_lens, fixed_cameras
from devrf.reconstruct.geometry.paths import orbit

if TYPE_CHECKING:  # it needs torch
    from devrf.reconstruct.splats.make import Splats

TIMES = "keys"
PAGE = "player.html"
MOST_BYTES = 25_000_000
ABOUT = 20_000  # bytes of views and words, at most
START = "start"
MOST_OF_SWEEP = 4  # views of a scene that has no fixed cameras
LAST = 0.02  # of the progress: packing and writing


def write(request: Request) -> None:
    """Write `player.html`."""
    count = shared.asked(request)
    trained = ExportedModel(request, TIMES)
    movers = trained.model.movers
    _check_size(count, len(trained.moments), 0 if movers is None else movers.parts)
    from devrf.reconstruct.splats.packed import pack

    with request.new_folder() as new, request.talk.progress("export player") as progress:
        made = shared.made(trained, count, part(progress, 0.0, 1 - LAST))
        packed = pack(made.gaussians, made.ways, made.nodes)
        views = [_told(*view) for view in _views(trained)]
        about = {**_about(trained, made), "splats": packed.about, "views": views}
        path = new / PAGE
        page = player_page(request.title, _subtitle(trained), about, packed.data)
        path.write_text(page, encoding="utf-8")
        progress(1.0, f"{path.stat().st_size / 1e6:.1f} MB written")
        trained.describe(
            new,
            files=f"{PAGE}: one page that needs nothing else; open it in a browser, or send it to anyone.",
            axes="the box frame of the model, `world_from_box` in export.json leads to the world of the calibration.",
            lengths=f"box units; one is {trained.scale:.6g} {trained.unit}",
            facts={"splats": packed.about, "bytes": path.stat().st_size},
        )


def _check_size(count: int, keys: int, nodes: int) -> None:
    """Raises InputError where the page could be larger than `MOST_BYTES`."""
    from devrf.reconstruct.splats.packed import size_at_most

    def size(n: int) -> int:
        return page_size(size_at_most(n, n, keys, nodes), ABOUT)

    if size(count) > MOST_BYTES:
        most = int(count * (MOST_BYTES - size(0)) / (size(count) - size(0)) / 1000) * 1000
        raise InputError(
            "page-too-large",
            f"--format player: with {count} splats at {keys} times the page could have {size(count) / 1e6:.0f} MB, "
            f"more than {MOST_BYTES / 1e6:.0f}; choose at most --splats {most}, or fewer --times",
        )


def _about(trained: ExportedModel, made: "Splats") -> dict[str, Any]:
    """What the page is told beside splats and views."""
    seconds = [moment.time_s or 0.0 for moment in trained.moments]
    return {
        "up": _span(trained).up.tolist(),
        "behind": made.behind.tolist(),
        "metres": trained.scale if trained.scene.metric else None,
        "times": seconds,
        "start": _telling(trained, seconds),
    }


def _telling(trained: ExportedModel, seconds: list[float]) -> float:
    """With which of the times the page begins."""
    from devrf.reconstruct.film.subject import subject_of

    subject, scene = subject_of(trained.model, film_cameras(trained.boxed)), trained.scene
    if subject is None:
        return seconds[0]
    at_s = scene.t0_s + subject.telling * (scene.t1_s - scene.t0_s)
    return min(seconds, key=lambda s: abs(s - at_s))


def _subtitle(trained: ExportedModel) -> str:
    moments, scene = trained.moments, trained.scene
    length = "" if len(moments) < 2 else f"{(moments[-1].time_s or 0) - (moments[0].time_s or 0):.1f} s, "
    unit = "metres" if scene.metric else "arbitrary scale"
    return f"{length}{unit}; made by devrf"


def _span(trained: ExportedModel) -> Span:
    return Span.of(film_cameras(trained.boxed), trained.boxed.aabb)


def _views(trained: ExportedModel) -> list[tuple[str, Camera, np.ndarray]]:
    """Names, cameras and what they look at: within the cameras' span first, then the cameras."""
    scene, target = trained.boxed, _span(trained).target
    cameras = film_cameras(scene)
    path = orbit(cameras, scene.aabb, 4, film_lens(cameras))
    fixed = fixed_cameras(scene)
    if not fixed:
        at = np.linspace(0, len(cameras) - 1, min(MOST_OF_SWEEP, len(cameras))).astype(int)
        fixed = {f"sweep {n + 1}": cameras[k] for n, k in enumerate(at.tolist())}
    named = [(START, path[1]), *fixed.items()]
    return [(name, camera, target) for name, camera in named]


def _told(name: str, camera: Camera, target: np.ndarray) -> dict[str, Any]:
    """A view as the page takes it."""
    K = camera.K
    return {
        "name": name,
        "turn": camera.cam_from_world[:, :3].ravel().tolist(),
        "eye": camera.centre.tolist(),
        "target": target.tolist(),
        "lens": {
            "focal": [K[0, 0], K[1, 1]],
            "centre": [K[0, 2], K[1, 2]],
            "size": [camera.width, camera.height],
        },
    }
