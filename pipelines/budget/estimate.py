"""What every stage needs, from the configuration and the pictures' sizes. Rough, and said to be (docs/budgets.md).

Memory is that of the whole process, with the libraries and the processes it starts. Each rate was measured with the
stage, or what takes its memory, in a process of its own, none on a GPU; docs/budgets.md has estimates beside what was
measured.
Times are those of the example session (72 sweep pictures, five cameras with 43 pictures each, 480x360) on two CPU
cores beside other jobs; other sessions and machines differ by a factor of `UNSURE` or more.
"""

import math
from collections.abc import Callable, Collection
from dataclasses import replace

from devrf.calibration.sweep.static_poses import FINE_OCTAVE_BELOW, MAX_IMAGE_SIZE
from devrf.capture.cores import usable_cores
from devrf.pipelines.budget.material import Material, Source
from devrf.pipelines.budget.need import Need
from devrf.pipelines.budget.training import BASE, FEW_S, model_bytes, training_need
from devrf.pipelines.clock_check import MOST_FRAMES
from devrf.pipelines.config.scene import SceneConfig
from devrf.pipelines.flow_clips import is_brought, training_clips
from devrf.pipelines.stages.render import SIZES
from devrf.pipelines.trained_model import PIECES
from devrf.reconstruct.options import CHUNK

UNSURE = 3

SFM_WORKER = 160_000_000  # bytes: the process of pycolmap with nothing to do

# Bytes for each pixel of a picture
REFERENCES = 12  # that the decoder of a clip keeps to predict others from
DECODED, DECODED_DEEP = 7, 30  # for each one decoded or written; with more than 8 bits, on its way to 8
PHOTO, RAW = 10, 30  # a photo read and measured; a RAW photo developed (12 to 24 megapixels: 23 to 29)
SIFT = 80  # each in which features are found, at the size at which they are: blurred copies and gradients
SIFT_READ = 5  # and at the full size, for reading
PAIR_FLOW = 190  # of a pair whose flow is found, both ways, and checked (480x360 to 3840x2160: 160 to 200)
RAFT_FLOW, RAFT_VOLUMES = 450, 1_400_000_000  # and by RAFT, of whose volumes there are at most so many bytes
BOARD = 30  # pictures of a board, of colours, one at a time
CACHED = 28  # surroundings of a camera
SCORED, LPIPS = 400, 1500  # pictures that are compared; and through the networks of LPIPS

SWEEP_PICTURE = 3_000_000  # bytes: a sweep picture's features, matches and points while the sweep is mapped
CHECKED_PICTURE = 1_700_000  # bytes: a moving picture whose clock is checked, with its flow at 320 pixels
SOUND = 48_000 * 64  # bytes a second while clocks are found: samples, onsets, their spectra
SOUND_READ = 48_000 * 16  # bytes a second of decoded sound
MOST_CACHED = 100_000_000  # bytes: surroundings of cameras that are remembered; 0.27 GB at the most
RAY = 8_000  # each of those that are rendered at once
LOADED = 2  # times a model's size in memory, while it is unpacked

# Disk, bytes
FLOW_STORED = 1.0  # for each pixel of a pair, packed; the example's 0.43, and 2.5 at the most
VIEW_STORED = 5.5  # for each pixel of a test picture: the true one, the rendered one, some errors
SWEEP_STORED = 300_000  # a sweep picture's features and points, and again in COLMAP's database meanwhile
PAIR_STORED = 2_000  # matches of a pair in the database
SOUND_STORED = 2 * 48_000  # a second, 16 bits
POSED = 4_000  # a picture with its camera in the scene's files
SMALL = 3_000_000  # what else a stage writes

# Seconds
INGEST_S_PER_MEGAPIXEL = 0.1
MATCHING_S_PER_PAIR = 0.02  # of sweep pictures, every one with every other
RIG_S_PER_CAMERA = 4.0
SCENE_S_PER_PICTURE = 0.15
FLOW_S_PER_MEGAPIXEL = 0.45
VIEW_S_PER_MEGAPIXEL = 13.0  # of test pictures, rendered in motion and at rest
CONFIDENCE_PICTURES = (
    5  # as many test pictures' time that confidence takes, whatever is tested: some are trained on
)
FILM_S_PER_MEGAPIXEL = 20.0


def stage_needs(
    config: SceneConfig, material: Material, device: str = "cpu", only: Collection[str] | None = None
) -> dict[str, Need]:
    """What each stage that applies needs, in the order in which they run; of `only` some, if given."""
    makers: dict[str, Callable[[], Need]] = {
        "ingest": lambda: _ingest(config, material),
        "static_poses": lambda: static_poses_need(config, material),
        "sync": lambda: _sync(material),
        "rig": lambda: _rig(material),
        "colour": lambda: _colour(material),
        "scene": lambda: _scene(material),
        "flow": lambda: _flow(config, material, device),
        "canonical": lambda: training_need("canonical", config, material, device),
        "deformation": lambda: training_need("deformation", config, material, device),
        "evaluate": lambda: _evaluate(config, material, device),
        "render": lambda: _render(config, material, device),
        "report": lambda: Need("report", BASE + 100_000_000, left=SMALL, seconds=FEW_S),
    }
    from devrf.pipelines.stages import STAGES

    applying = [stage.name for stage in STAGES if stage.applies(config) is None]
    return {name: makers[name]() for name in applying if only is None or name in only}


def _ingest(config: SceneConfig, material: Material) -> Need:
    sources = material.sources.values()
    clips = [source for source in sources if source.kind == "clip"]
    raws = [source for source in sources if source.kind == "raw"]
    photos = [source for source in sources if source.kind == "photos"]
    held = [REFERENCES * (s.bits > 8) * s.pixels + REFERENCES * s.pixels for s in clips]
    held += [PHOTO * s.pixels for s in photos]
    each = [(DECODED_DEEP if s.bits > 8 else DECODED) * s.pixels for s in clips] + [
        RAW * s.pixels for s in raws
    ]
    sound_s = sum(source.sound_s for source in sources)
    largest = max(each, default=0)
    return Need(
        "ingest",
        BASE
        + max(held, default=0)
        + largest
        + int(SOUND_READ * sound_s),  # the writer has one more in its hands
        largest,
        usable_cores(),
        left=int(sum(s.used * s.bytes_each for s in sources) + SOUND_STORED * sound_s) + SMALL,
        passing=int(sum((s.pictures - s.used) * s.bytes_each for s in (*photos, *raws))),
        seconds=FEW_S + INGEST_S_PER_MEGAPIXEL * sum(_megapixels(s) for s in sources),
    )


def static_poses_need(config: SceneConfig, material: Material, side_px: int = MAX_IMAGE_SIZE) -> Need:
    """Of structure from motion, features being found at a longer side of at most `side_px`."""
    sweep = material.sweep
    if sweep is None:
        return Need("static_poses", BASE)
    pairs = sweep.used * (sweep.used - 1) / 2
    limit = config.calibration.static_poses.time_minutes
    return Need(
        "static_poses",
        BASE + SFM_WORKER + SIFT_READ * sweep.pixels + SWEEP_PICTURE * sweep.used,
        SIFT * _searched_pixels(sweep, side_px),
        usable_cores(),
        left=SWEEP_STORED * sweep.used + SMALL,
        passing=SWEEP_STORED * sweep.used + int(PAIR_STORED * pairs),
        seconds=FEW_S + min(MATCHING_S_PER_PAIR * pairs, math.inf if limit is None else 60 * limit),
    )


def _searched_pixels(source: Source, side_px: int) -> int:
    """Pixels of a picture as SIFT blurs it: reduced, or doubled where it is small."""
    longest = max(source.width, source.height)
    scale = min(1.0, side_px / longest) * (2 if longest <= FINE_OCTAVE_BELOW else 1)
    return int(source.pixels * scale**2)


def _sync(material: Material) -> Need:
    sound_s = sum(source.sound_s for source in material.sources.values())
    return Need("sync", BASE + int(SOUND * sound_s), left=SMALL, seconds=FEW_S)


def _rig(material: Material) -> Need:
    fixed = [s for s in material.sources.values() if s.role in ("camera", "test")]
    largest = max((s.pixels for s in material.sources.values()), default=0)
    sweep = 0 if material.sweep is None else material.sweep.used
    return Need(
        "rig",
        BASE + SFM_WORKER + BOARD * largest + SWEEP_PICTURE // 3 * sweep,
        max((SIFT * _searched_pixels(s, MAX_IMAGE_SIZE) for s in fixed), default=0),
        usable_cores(),
        left=SMALL,
        passing=int(sum(10 * s.bytes_each for s in fixed)),
        seconds=FEW_S + RIG_S_PER_CAMERA * len(fixed),
    )


def _colour(material: Material) -> Need:
    largest = max((s.pixels for s in material.sources.values()), default=0)
    return Need("colour", BASE + BOARD * largest, left=SMALL, seconds=FEW_S)


def _scene(material: Material) -> Need:
    fixed = [s for s in material.sources.values() if s.role in ("camera", "test")]
    checked = sum(min(MOST_FRAMES, s.used) for s in fixed)
    pictures = material.at_rest + material.in_motion + material.tested
    return Need(
        "scene",
        BASE + CHECKED_PICTURE * checked,
        left=POSED * pictures + SMALL,
        seconds=FEW_S + SCENE_S_PER_PICTURE * checked,
    )


def _flow(config: SceneConfig, material: Material, device: str) -> Need:
    full = material.full_pixels
    raft = finds_by_raft(config, material)
    there = device == "cuda" and raft
    work = RAFT_VOLUMES + RAFT_FLOW * full if raft else 0
    return Need(
        "flow",
        BASE + (0 if there else work) + (PAIR_FLOW * full if raft else 0),
        0 if raft else PAIR_FLOW * full,
        1 if raft else usable_cores(),
        gpu=work if there else 0,
        left=int(FLOW_STORED * material.pixels * material.in_motion) + SMALL,
        seconds=None if raft else FEW_S + FLOW_S_PER_MEGAPIXEL * full * material.in_motion / 1e6,
    )


def finds_by_raft(config: SceneConfig, material: Material) -> bool:
    """Whether flow is RAFT's: where a data set brings it, none has to be found."""
    if config.flow.method != "raft" or material.scene is None:
        return config.flow.method == "raft"
    return not is_brought(training_clips(material.scene))


def _evaluate(config: SceneConfig, material: Material, device: str) -> Need:
    pixels = material.pixels
    lpips = LPIPS * pixels if config.evaluate.lpips_weights else 0
    need = _rendering("evaluate", config, material, device, pixels, lpips)
    return replace(
        need,
        base=need.base + SCORED * pixels,
        left=int(VIEW_STORED * pixels * material.tested) + SMALL,
        seconds=FEW_S + VIEW_S_PER_MEGAPIXEL * pixels * (material.tested + CONFIDENCE_PICTURES) / 1e6,
    )


def _render(config: SceneConfig, material: Material, device: str) -> Need:
    count, _, most = SIZES[config.preset]
    pixels = min(most, max(material.full_pixels, material.pixels))
    need = _rendering("render", config, material, device, pixels, 0)
    return replace(need, left=SMALL, seconds=FEW_S + FILM_S_PER_MEGAPIXEL * pixels * count / 1e6)


def _rendering(
    stage: str, config: SceneConfig, material: Material, device: str, pixels: int, more: int
) -> Need:
    """A model in memory, and rays in pieces."""
    held = LOADED * model_bytes(config, material) + CACHED * pixels + MOST_CACHED + more
    if device == "cuda":
        base = 2 * BASE + model_bytes(config, material)
        return Need(stage, base, at_once=PIECES, gpu=held + CHUNK * RAY)
    return Need(stage, BASE + held, CHUNK * RAY // PIECES, PIECES)


def _megapixels(source: Source) -> float:
    """Of all pictures that are kept."""
    return source.used * source.pixels / 1e6
