"""Compare a model with pictures it was never trained on, and with what it would show if nothing moved.

`test`: the moving scene's test pictures, every frame (the held-out sweep pictures where nothing moves).
`test_static`: the held-out sweep pictures. `test_moving`: the moving scene's test pictures, only pixels that move: by
the truth's masks, or where they differ from the same camera's own picture of what stands (`still_picture`), so that
no model decides what counts. `test_rest`: the model at rest against that picture of what stands, where it is known.
`static_baseline`: the same test pictures against the canonical model as if nothing moved: what motion must beat.
`shading`: where it moves, in some of the test pictures, with the shading of movers and without it.
PSNR is taken per picture and then averaged. All this is by the clocks as they were calibrated, and nothing is fitted.
`test_moving_retimed`, beside `test_moving` where a test camera's clock is not known: one offset of its clock, found on
its pictures in even places, and scored on those in odd places.
"""

import time as clock
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32

from devrf.capture.camera import Camera
from devrf.capture.photos.picture_files import write_png
from devrf.capture.photos.resize import shrink
from devrf.capture.scene import PosedFrame, Scene, load_image
from devrf.capture.system.errors import ReconstructError
from devrf.capture.system.progress import Progress, no_progress
from devrf.capture.system.spread import spread
from devrf.reconstruct.evaluation.error_map import error_map
from devrf.reconstruct.evaluation.lpips import SMALLEST_SIDE as LPIPS_SMALLEST_SIDE
from devrf.reconstruct.evaluation.lpips import Lpips
from devrf.reconstruct.evaluation.lpips_weights import Source
from devrf.reconstruct.evaluation.metrics import SSIM_TAPS, Comparison, Scores, psnr
from devrf.reconstruct.sampling.clean_plate import StillPicture, still_picture
from devrf.reconstruct.sampling.pictures import in_two

Render = Callable[[Camera, float | None], Float32[np.ndarray, "height width 3"]]
"""`render(camera, time)`: RGB of a camera in the box frame at a time in [0, 1]; None: the scene at rest."""

METRICS = ("psnr", "ssim", "lpips_vgg", "lpips_alex")
EXTRA_PICTURES = 12  # error maps and pictures at rest that are kept, spread over the views
LEAST_MOVING = 1e-3  # of the picture; of fewer moving pixels a picture has no score, which noise would decide
NO_TEST_CAMERA = "no test camera: name one under capture.test_cameras"
NO_STILL = "no test camera that stands and has enough pictures; compare test with static_baseline.test"

Scored = dict[str, float | None]


@dataclass(frozen=True)
class LpipsNets:
    """The networks at hand by name (`vgg`, `alex`), and why the others are not."""

    nets: Mapping[str, Lpips]
    why: Mapping[str, str]

    @staticmethod
    def load(source: Source | None, device: str = "cpu") -> "LpipsNets":
        """Take what there is in a folder or to download; what is missing is said, not replaced."""
        nets, why = {}, {}
        for net in ("vgg", "alex"):
            if source is None:
                why[net] = "no LPIPS weights are given (evaluate.lpips_weights)"
                continue
            try:
                nets[net] = Lpips(net, source, device)
            except ReconstructError as error:
                why[net] = str(error)
        return LpipsNets(nets, why)


@dataclass(frozen=True)
class Known:
    """What is known beside the scene and the model.

    Attributes:
        masks: What moves in truth in a camera's pictures, by their numbers in its file, of any size.
        unshaded: The model without its shading; None: it has none.
        test_clocks: Of test cameras whose clocks are not known `offset_s`, seconds by which their pictures were taken
            later than the scene says, found on those in even places, or None and `why`.
        absent: Why the scene in motion has no test views, where it has none.
    """

    masks: Mapping[str, Bool[np.ndarray, "frames h w"]] = field(default_factory=dict)
    unshaded: Render | None = None
    test_clocks: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    absent: str = NO_TEST_CAMERA


NOTHING_KNOWN = Known()


def evaluate(
    scene: Scene,
    render: Render,
    lpips: LpipsNets,
    out: Path,
    progress: Progress = no_progress,
    known: Known = NOTHING_KNOWN,
) -> dict[str, Any]:
    """Render and score all test pictures; see the module's text for the blocks of the result.

    Args:
        scene: With its cameras in any frame; they are moved into the box frame here.
        render: The model.
        lpips: Networks for LPIPS.
        out: Folder to write `views/<camera>/<index>_{true,rendered,rest,error}.png` into.
        progress: Told how far it is.
        known: Beside the scene and the model.
    Returns:
        `test`, `test_static`, `test_moving`, `test_rest`, `static_baseline`, `shading`, `per_view`, `still_pictures`,
        `render_fps`; with `test_clocks` also `test_moving_retimed`.
    """
    scene = scene.in_box_frame()
    moving = sorted(
        (f for f in scene.dynamic if f.split == "test"), key=lambda f: (f.camera_name, f.time or 0.0, f.index)
    )
    still = [f for f in scene.static if f.split == "test"]
    session = _Session(scene, render, lpips, out, progress, len(moving) + len(still), known.unshaded)
    names = sorted({f.camera_name for f in moving})
    standing = {name: still_picture(scene, [f for f in moving if f.camera_name == name]) for name in names}
    extra = spread(range(len(moving)), EXTRA_PICTURES)
    times = _retimed(scene, moving, known.test_clocks)
    views = [
        session.moving_view(
            f,
            standing[f.camera_name],
            known.masks.get(f.camera_name),
            n in extra,
            times.get((f.camera_name, f.index)),
        )
        for n, f in enumerate(moving)
    ]
    at_rest = [
        session.rest_view(next(f for f in moving if f.camera_name == n), s) for n, s in standing.items() if s
    ]
    extra = spread(range(len(still)), EXTRA_PICTURES)
    still_views = [session.still_view(f, n in extra) for n, f in enumerate(still)]

    nothing_held_out = "no sweep picture is held out"
    absent = known.absent
    test_static = _block([v["scores"] for v in still_views], lpips, nothing_held_out)
    if scene.dynamic:
        test = _block([v["scores"] for v in views], lpips, absent)
    else:
        absent, test = "nothing moves in this capture", test_static
    later = [v for v in views if v["moving"] is not None]
    parts = {
        name: [v[name] for v in later if v[name]["psnr"] is not None] for name in ("moving", "rest_moving")
    }
    no_pixels = (
        absent if not moving else NO_STILL if not (later or at_rest) else "nothing moves in the test views"
    )
    retimed, retimed_baseline = _retimed_blocks(views, lpips, known.test_clocks, no_pixels)
    return {
        "test": test,
        "test_static": test_static,
        "test_moving": _block(parts["moving"], lpips, no_pixels),
        **retimed,
        "test_rest": _block([v["scores"] for v in at_rest], lpips, NO_STILL if moving else absent),
        "static_baseline": {
            "test": _block([v["rest_scores"] for v in views], lpips, absent),
            "test_moving": _block(parts["rest_moving"], lpips, no_pixels),
            **retimed_baseline,
        },
        "shading": _shading([v["shading"] for v in views if v["shading"] is not None]),
        "per_view": [_row(view) for view in views + still_views],
        "still_pictures": [
            {key: view[key] for key in ("camera", "source", "known")} | view["scores"] | view["files"]
            for view in at_rest
        ],
        "render_fps": session.frames_per_second(),
    }


@dataclass
class _Session:
    """Renders and scores one view after the other; keeps the last picture at rest of a camera that stands."""

    scene: Scene
    render: Render
    lpips: LpipsNets
    out: Path
    progress: Progress
    count: int
    unshaded: Render | None
    done: int = 0
    seconds: list[float] = field(default_factory=list)
    rest: tuple[tuple[object, ...], np.ndarray] | None = None

    def moving_view(
        self,
        frame: PosedFrame,
        still: StillPicture | None,
        masks: np.ndarray | None,
        extra: bool,
        retimed: float | None,
    ) -> dict[str, Any]:
        """Scores of a test picture of the moving scene, of the baseline, and of both where it moves.

        With `retimed` also where it moves, at that time.
        """
        true, camera = self._true(frame)
        rest = self._at_rest(camera)
        rendered = self._timed(camera, frame.time)
        true_features = self._features(true)
        moved, stood = Comparison(rendered, true), Comparison(rest, true)
        view = {
            **_identity(frame),
            "scores": _scored(moved.whole()) | self._lpips(rendered, true_features),
            "rest_scores": _scored(stood.whole()) | self._lpips(rest, true_features),
            "moving": None,
            "rest_moving": None,
            "moving_share": None,
            "retimed": None,
            "shading": None,
        }
        where = _moving(true, still, None if masks is None else masks[frame.index])
        if where is not None and where.mean() >= LEAST_MOVING:
            view["moving"] = _scored(moved.part(where))
            view["rest_moving"] = _scored(stood.part(where))
            view["moving_share"] = round(float(where.mean()), 5)
            if retimed is not None:
                later = Comparison(self.render(camera, retimed), true)
                view["retimed"] = {"time": retimed, **_scored(later.part(where))}
            if extra and self.unshaded is not None:
                view["shading"] = (
                    view["moving"]["psnr"],
                    psnr(self.unshaded(camera, frame.time)[where], true[where]),
                )
        pictures = {"true": true, "rendered": rendered}
        if extra:
            pictures |= {"rest": rest, "error": error_map(rendered, true)}
        view["files"] = self._save(frame, pictures)
        return view

    def rest_view(self, frame: PosedFrame, still: StillPicture) -> dict[str, Any]:
        """Scores of the model at rest against what a test camera shows of what stands, where that is known."""
        rest = self._at_rest(frame.camera.scaled(self.scene.image_scale))
        pictures = {"still": np.where(still.known[..., None], still.picture, 0), "at_rest": rest}
        files = self._save(frame, pictures)
        return {
            "camera": frame.camera_name,
            "source": still.source,
            "known": round(float(still.known.mean()), 5),
            "scores": _scored(Comparison(rest, still.picture).part(still.known)),
            "files": {"true": files["still"], "rendered": files["at_rest"]},
        }

    def still_view(self, frame: PosedFrame, extra: bool) -> dict[str, Any]:
        """Scores of a held-out sweep picture."""
        true, camera = self._true(frame)
        rendered = self._timed(camera, None)
        pictures = {"true": true, "rendered": rendered}
        if extra:
            pictures["error"] = error_map(rendered, true)
        return {
            **_identity(frame),
            "scores": _scored(Comparison(rendered, true).whole())
            | self._lpips(rendered, self._features(true)),
            "files": self._save(frame, pictures),
        }

    def frames_per_second(self) -> float | None:
        """Median over the views; the first one, which may compile, is left out where there are more."""
        seconds = self.seconds[1:] or self.seconds
        return round(1 / float(np.median(seconds)), 4) if seconds else None

    def _true(self, frame: PosedFrame) -> tuple[np.ndarray, Camera]:
        self.progress(self.done / max(self.count, 1), f"{self.done} of {self.count} test pictures")
        self.done += 1
        picture = load_image(frame, self.scene.image_scale, self.scene.background)
        return picture.astype(np.float32) / 255, frame.camera.scaled(self.scene.image_scale)

    def _at_rest(self, camera: Camera) -> np.ndarray:
        if self.rest is None or self.rest[0] != camera.view:
            self.rest = (camera.view, self.render(camera, None))
        return self.rest[1]

    def _timed(self, camera: Camera, time: float | None) -> np.ndarray:
        """A picture; only rendering is timed."""
        begin = clock.perf_counter()
        rendered = self.render(camera, time)
        self.seconds.append(clock.perf_counter() - begin)
        return rendered

    def _features(self, picture: np.ndarray) -> dict[str, Any]:
        if min(picture.shape[:2]) < LPIPS_SMALLEST_SIDE:
            return {}
        return {name: net.features(picture) for name, net in self.lpips.nets.items()}

    def _lpips(self, picture: np.ndarray, true_features: Mapping[str, Any]) -> Scored:
        scores: Scored = {"lpips_vgg": None, "lpips_alex": None}
        for name, features in self._features(picture).items():
            scores[f"lpips_{name}"] = self.lpips.nets[name].distance(features, true_features[name])
        return scores

    def _save(self, frame: PosedFrame, pictures: Mapping[str, np.ndarray]) -> dict[str, str]:
        folder = self.out / "views" / frame.camera_name
        folder.mkdir(parents=True, exist_ok=True)
        files = {}
        for kind, picture in pictures.items():
            path = folder / f"{frame.index:06d}_{kind}.png"
            write_png(path, np.clip(np.round(picture * 255), 0, 255).astype(np.uint8))
            files[kind] = path.relative_to(self.out).as_posix()
        return files


def motion_psnr(metrics: Mapping[str, Any]) -> tuple[float | None, float | None]:
    """PSNR of test views and of the same if nothing moved: where they move, or whole where no test camera stands."""
    unknown = metrics["test_moving"]["psnr"] is None and not metrics["test_rest"]["views"]
    block = "test" if unknown else "test_moving"
    return metrics[block]["psnr"], metrics["static_baseline"][block]["psnr"]


def _retimed(
    scene: Scene, moving: Sequence[PosedFrame], clocks: Mapping[str, Mapping[str, Any]]
) -> dict[tuple[str, int], float]:
    """Times of the pictures in odd places, by camera and number, with the clocks that were found on the others.

    Pictures that a clock takes out of the modelled time are scored at its end, so that all of them count.
    """
    times = {}
    for name, found in clocks.items():
        if found["offset_s"] is not None:
            later = found["offset_s"] / (scene.t1_s - scene.t0_s)
            for frame in in_two([f for f in moving if f.camera_name == name])[1]:
                times[name, frame.index] = min(1.0, max(0.0, (frame.time or 0.0) + later))
    return times


def _retimed_blocks(
    views: Sequence[Mapping[str, Any]],
    lpips: LpipsNets,
    clocks: Mapping[str, Mapping[str, Any]],
    no_pixels: str,
) -> tuple[dict[str, Any], dict[str, Any]]:
    """`test_moving_retimed` of the model and of the baseline; none where all clocks are known.

    Beside the scores: `offsets_ms` by camera, and the same pictures by the clocks as they were calibrated.
    """
    if not clocks:
        return {}, {}
    unclear = "; ".join(f"clock of {name}: {c['why']}" for name, c in clocks.items() if c["offset_s"] is None)
    scored = [view for view in views if view["retimed"] is not None]
    offsets_ms = {name: None if c["offset_s"] is None else 1e3 * c["offset_s"] for name, c in clocks.items()}
    of = {
        key: _block([v[key] for v in scored if v[key]["psnr"] is not None], lpips, unclear or no_pixels)
        for key in ("retimed", "moving", "rest_moving")
    }
    block = of["retimed"] | {"offsets_ms": offsets_ms, "calibrated_psnr": of["moving"]["psnr"]}
    return {"test_moving_retimed": block}, {"test_moving_retimed": of["rest_moving"]}


def _moving(
    true: np.ndarray, still: StillPicture | None, mask: np.ndarray | None
) -> Bool[np.ndarray, "height width"] | None:
    """Where a test picture moves: by the truth, or against what stands; None where neither is known."""
    if mask is not None:
        return shrink(mask.astype(np.float32), true.shape[1], true.shape[0]) > 0.5
    return None if still is None else still.moving(true)


def _scored(scores: Scores) -> Scored:
    return {"psnr": scores.psnr, "ssim": scores.ssim}


def _identity(frame: PosedFrame) -> dict[str, Any]:
    return {"camera": frame.camera_name, "index": frame.index, "time": frame.time, "time_s": frame.time_s}


def _row(view: dict[str, Any]) -> dict[str, Any]:
    """A view as written to metrics.json: name, scores, files; what does not apply is left out."""
    row = {key: view[key] for key in ("camera", "index", "time", "time_s")} | view["scores"]
    if "rest_scores" in view:
        row["static_baseline"] = dict(view["rest_scores"])
    if view.get("moving"):
        row["moving"] = {**view["moving"], "share": view["moving_share"]}
        row["static_baseline"]["moving"] = view["rest_moving"]
    if view.get("retimed"):
        row["retimed"] = view["retimed"]
    return row | view["files"]


def _block(scores: Sequence[Scored], lpips: LpipsNets, absent: str) -> dict[str, Any]:
    """Means over views; a metric without any value is null and says why."""
    block: dict[str, Any] = {}
    why: dict[str, str] = {}
    for metric in METRICS:
        values = [s[metric] for s in scores if s.get(metric) is not None]
        block[metric] = float(np.mean([v for v in values if v is not None])) if values else None
        if not values:
            why[metric] = _why(metric, scores[0], lpips) if scores else absent
    block["views"] = len(scores)
    return {**block, "why": why} if why else block


def _shading(scores: Sequence[tuple[float, float]]) -> dict[str, Any]:
    """PSNR with and without shading, of the pictures that were rendered without, too."""
    on, off = np.mean(scores, axis=0).tolist() if scores else (None, None)
    return {"psnr": on, "unshaded_psnr": off, "views": len(scores)}


def _why(metric: str, example: Scored, lpips: LpipsNets) -> str:
    if metric == "ssim":
        return f"no window of {SSIM_TAPS} pixels fits into the pictures"
    if metric not in example:
        return "LPIPS is defined on whole pictures only"
    too_small = f"pictures have fewer than {LPIPS_SMALLEST_SIDE} pixels a side"
    return lpips.why.get(metric.removeprefix("lpips_"), too_small)
