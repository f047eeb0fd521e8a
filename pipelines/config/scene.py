"""scene.yaml as strict, frozen values: what a user may say, its defaults, its ranges.

Every key of the contract is here. Unknown keys are errors; values of the right type but out of range
are errors; a value that no stage can act on yet is refused rather than ignored. Paths are kept as
written, relative to the file (`SceneConfig.path`). Reading the file, overrides and messages are in
`load.py`. `None` in `reconstruct` means: chosen by the preset and from the scene.
"""

import os
import unicodedata
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PrivateAttr,
    field_validator,
    model_validator,
)

from devrf.capture.rest import Rest
from devrf.capture.system.file_names import is_safe, safe
from devrf.flow.methods import installed, mistake
from devrf.pipelines.config.gone import GONE
from devrf.pipelines.config.words import shown
from devrf.reconstruct.options import OWN_MOTION, PresetName

Kind = Literal["dynamic", "sweep", "cameras", "dataset"]

FORMATS_AT_REST = ("blender", "llff", "colmap")
LONGEST_PATH, LONGEST_NAME = 1000, 255  # characters, bytes: every system takes these
LONGEST_CAMERA = 64  # characters of a camera's name, which becomes folder and file names
RESERVED_NAMES = ("static",)  # the sweep's own name in the run folder
RESERVED_PREFIXES = ("board_", "joint_")  # board clips' names in the run folder


def _as_tuple(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


def _path(text: str) -> str:
    """A text that can be a path on any system; whether there is such a file is asked later."""
    reason = None
    try:
        parts = os.fsencode(Path(text).expanduser()).split(os.fsencode(os.sep))
        if len(text) > LONGEST_PATH or max(map(len, parts)) > LONGEST_NAME:
            reason = f"longer than {LONGEST_PATH} characters, or a name in it than {LONGEST_NAME} bytes"
        elif "\0" in text:
            reason = "holds a zero byte"
    except UnicodeEncodeError:
        reason = "holds half a character"
    except RuntimeError:
        reason = "no such user"
    if reason is not None:
        raise ValueError(f"{shown(text)}: {reason}; expected a path")
    return text


PathText = Annotated[str, AfterValidator(_path), Field(json_schema_extra={"format": "path"})]
AutoBool = Literal["auto"] | bool
Squares = Annotated[int, Field(ge=2, le=100)]
Share = Annotated[float, Field(ge=0, le=1)]
Gain = Annotated[float, Field(gt=0, le=100)]


def is_camera_name(name: str) -> bool:
    """Whether a camera can be called so: letters of any alphabet, digits, _ and -."""
    return 0 < len(name) <= LONGEST_CAMERA and is_safe(name) and name[0] not in "_-"


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class BoardConfig(_Section):
    """A calibration board: intrinsics of the cameras, and metric scale."""

    type: Literal["charuco", "chessboard", "aruco_grid"] = "charuco"
    """What is printed; aruco_grid is OpenCV's GridBoard, or Kalibr's aprilgrid (dictionary DICT_APRILTAG_36h11)."""
    squares: Annotated[tuple[Squares, Squares], BeforeValidator(_as_tuple)]
    """Columns and rows, from 2 to 100: squares of a ChArUco board, inner corners of a chessboard, markers of an
    ArUco grid. Swapped, or a chessboard's squares for its corners: found out and said."""
    square_m: float | None = Field(default=None, gt=0, le=10)
    """Side of a square (needed, but not of an ArUco grid)."""
    marker_m: float | None = Field(default=None, gt=0, le=10)
    """Side of a marker (needed, but not of a chessboard); of a ChArUco board smaller than the square."""
    separation_m: float | None = Field(default=None, gt=0, le=10)
    """Gap between two markers of an ArUco grid (needed there)."""
    metric: bool = True
    """Whether these lengths were measured; false: only their proportions are true (`square_m: 1.0`): the board
    gives lenses and poses, and the scale stays arbitrary."""
    dictionary: str = Field(default="DICT_5X5_100", pattern="^DICT_[A-Za-z0-9_]+$")
    """OpenCV's name of the marker dictionary (not of a chessboard)."""
    inverted: AutoBool = "auto"
    """Whether the print is white on black; auto tries both."""
    legacy: AutoBool = "auto"
    """Whether the layout is the one from before OpenCV 4.6; auto tries both."""
    lens: Literal["auto", "pinhole", "fisheye"] = "auto"
    """Lens model of the calibrations; auto takes a fisheye where the view is wider than 90 degrees and it fits
    better."""
    clips: dict[str, PathText] = {}
    """Camera, or static for the sweep's -> clip of the board before this camera alone: intrinsics."""
    joint_clips: dict[str, PathText] = {}
    """Camera -> clip of the board before several cameras at once: intrinsics, rig and scale. Where the board is in
    the moving clips, name those here again."""

    @model_validator(mode="after")
    def _marker(self) -> "BoardConfig":
        needed = {
            "charuco": ("square_m", "marker_m"),
            "chessboard": ("square_m",),
            "aruco_grid": ("marker_m", "separation_m"),
        }[self.type]
        for key in needed:
            if getattr(self, key) is None:
                raise ValueError(f"{key} is missing; a board of type {self.type} needs it, in metres")
        for key in ("square_m", "separation_m"):
            if key not in needed and getattr(self, key) is not None:
                raise ValueError(f"{key} is not for a board of type {self.type}")
        if self.type == "charuco" and (self.marker_m or 0.0) >= (self.square_m or 0.0):
            raise ValueError(f"marker_m {self.marker_m} is not smaller than square_m {self.square_m}")
        return self


class RawConfig(_Section):
    """How RAW photos are developed; one recipe for all photos of a folder."""

    white_balance: Literal["auto"] | Annotated[tuple[Gain, Gain, Gain, Gain], BeforeValidator(_as_tuple)] = (
        "auto"
    )
    """Multipliers [r, g, b, g2] for all RAW photos, above 0, at most 100; auto: daylight by the sensor of each
    folder's first photo."""


class MattesConfig(_Section):
    """Where the subject is, picture by picture."""

    method: Literal["given", "chroma"]
    """given: a folder of mattes; chroma: a coloured screen."""
    folder: PathText | None = None
    """given: holds a folder per camera, and `static` for the sweep."""
    inverted: AutoBool = "auto"
    """given: whether the subject is black on white."""
    colour: str = Field(default="auto", pattern="^(auto|#[0-9a-fA-F]{6})$")
    """chroma: the screen's colour, auto or #rrggbb; auto finds each camera's."""

    @model_validator(mode="after")
    def _keys_of_the_method(self) -> "MattesConfig":
        if self.method == "given" and not self.folder:
            raise ValueError("folder is missing; method: given needs it")
        for key in sorted(self.model_fields_set - {"method"}):
            if METHOD_OF[key] != self.method:
                raise ValueError(f"{key} is for method: {METHOD_OF[key]}, and the method is {self.method}")
        return self


METHOD_OF = {"folder": "given", "inverted": "given", "colour": "chroma"}


def _mattes(value: Any) -> Any:
    """A word is a method that needs no more, or a folder."""
    if not isinstance(value, str):
        return value
    is_method = value == "chroma" or f"capture.mattes.method: {value}" in GONE
    return {"method": value} if is_method else {"method": "given", "folder": value}


class CaptureConfig(_Section):
    """The raw files of one capture."""

    static: PathText | None = None
    """The sweep of the scene at rest: a video, or a folder of images or RAW files."""
    cameras: dict[str, PathText] = {}
    """Fixed cameras of the moving scene: name -> clip. The first one that is trained on is cam0, whose clock is
    everyone's."""
    test_cameras: dict[str, PathText] | list[str] = {}
    """Cameras that are never trained on: name -> clip, or a list of names out of `cameras`."""
    timestamps: PathText | None = None
    """Table of true times (CSV with camera, frame_index, time_s), where the clips' own are not."""
    range_s: Annotated[tuple[float, float], BeforeValidator(_as_tuple)] | None = None
    """[from, to]: the part to model, on cam0's clock; default: from the first to the last moment at which at least two
    training cameras film (one, where there is only one)."""
    rest: Rest = "auto"
    """When the moving clips show the scene as in the sweep: start, middle, end or none; auto: that is measured.
    Start and end also help clocks without sound: nothing moves beyond that end of a clip."""
    board: BoardConfig | None = None
    """The calibration board, where one was filmed."""
    raw: RawConfig = RawConfig()
    """RAW photos."""
    mattes: Annotated[MattesConfig, BeforeValidator(_mattes)] | None = None
    """Mattes of the subject: a folder with one per camera, and `static` for the sweep; `chroma`; or a section. A room
    needs none."""

    @field_validator("range_s")
    @classmethod
    def _ordered(cls, range_s: tuple[float, float] | None) -> tuple[float, float] | None:
        if range_s is not None and not range_s[0] < range_s[1]:
            raise ValueError(f"{list(range_s)}; expected [from, to] with from < to, seconds")
        return range_s

    @property
    def training_cameras(self) -> dict[str, str]:
        """Cameras that are trained on: name -> clip, in the order of the file."""
        return {name: clip for name, clip in self.cameras.items() if name not in self.test_names}

    @property
    def test_names(self) -> tuple[str, ...]:
        """Names of the cameras that are never trained on."""
        return tuple(self.test_cameras)

    @property
    def all_cameras(self) -> dict[str, str]:
        """Every fixed camera, the test cameras last: name -> clip."""
        test = self.test_cameras if isinstance(self.test_cameras, dict) else {}
        return {**self.training_cameras, **self.cameras, **test}


class DatasetConfig(_Section):
    """A finished data set, instead of `capture` and `calibration`."""

    format: Literal["devrf", "blender", "nerfstudio", "llff", "colmap"]
    """Layout of the files."""
    path: PathText
    """Folder of the data set."""
    frame_stride: int = Field(default=1, ge=1, le=1000)
    """Use every n-th time, of the test views too."""
    background: (
        Literal["auto", "white", "black", "shell"]
        | Annotated[tuple[Share, Share, Share], BeforeValidator(_as_tuple)]
    ) = "auto"
    """What is behind the subject: auto, a plain colour (white, black or [r, g, b] from 0 to 1), or surroundings
    (shell)."""
    _without_times: bool = PrivateAttr(default=False)

    @property
    def at_rest(self) -> bool:
        """Whether nothing moves in it: by its format, or as `look` saw."""
        return self.format in FORMATS_AT_REST or self._without_times

    def look(self, folder: Path) -> None:
        """See in the data set whether anything moves, where its format leaves that open."""
        if self.format == "nerfstudio":
            from devrf.capture.formats.nerfstudio import is_at_rest  # not for every command

            self._without_times = is_at_rest(folder)


class StaticPosesConfig(_Section):
    """Structure from motion of the sweep."""

    mapper: Literal["incremental", "global", "both"] = "incremental"
    """COLMAP's mapper to begin with; others are tried where it fails; both: run both, keep the better model."""
    masks: PathText | None = None
    """Folder of masks of what moves or reflects in the sweep, black is ignored: `IMG_1.jpg.png` or `IMG_1.png` by
    photo, `000012.png` or `12.png` by frame of a film, counted from 0, or from 1 where they end with the number of
    frames; of the picture's size, upright. Pictures without one are used whole."""


class SyncConfig(_Section):
    """Each camera's clock."""

    method: Literal["auto", "audio", "motion", "flash", "timestamps", "none"] = "auto"
    """Cue for the clocks; auto takes the best there is; timestamps: the table, else timecode; none trusts the
    files' own times."""
    av_lag_s: dict[str, Annotated[float, Field(ge=-1, le=1)]] = {}
    """Camera -> how late its sound is behind its pictures (in-camera lag), from -1 to 1."""
    readout_s: dict[str, Annotated[float, Field(gt=0, le=0.1)]] = {}
    """Camera -> time in which its rolling shutter reads a picture, above 0, up to 0.1; several flashes find it
    without."""


class RigConfig(_Section):
    """The fixed cameras' poses."""

    method: Literal["auto", "sweep", "board", "given"] = "auto"
    """Where they come from; auto: `given` where there is one, else the sweep, else the board."""
    given: PathText | dict[str, PathText] | None = None
    """A calibration people already own: a file or folder, or camera name -> OpenCV file of that camera."""
    given_unit: Literal["m", "cm", "mm"] | None = None
    """Unit of the lengths in `given`; default: what its format says."""
    known_distance_m: float | None = Field(default=None, gt=0, le=10_000)
    """Distance between the centres of the first two cameras: gives the metric scale, also of a `given` calibration
    without one."""


class ColourConfig(_Section):
    """Cameras brought to one look."""

    method: Literal["auto", "points", "none"] = "auto"
    """How cameras are brought to the look of the sweep's, else of the first: auto and points: by surface points that
    two cameras see; none: they stay as filmed."""


class CalibrationConfig(_Section):
    """How cameras and clocks are recovered."""

    static_poses: StaticPosesConfig = StaticPosesConfig()
    """Structure from motion of the sweep."""
    sync: SyncConfig = SyncConfig()
    """Clocks."""
    rig: RigConfig = RigConfig()
    """Fixed cameras."""
    colour: ColourConfig = ColourConfig()
    """Colours."""


class FlowConfig(_Section):
    """Optical flow of the moving clips."""

    method: str = "dis"
    """Estimator: dis, raft, or one that an installed package adds."""
    weights: PathText | None = None
    """For raft: the authors' checkpoint or torchvision's state dict, small or large."""

    @model_validator(mode="after")
    def _usable(self) -> "FlowConfig":
        if wrong := mistake(self.method, self.weights):
            raise ValueError(wrong)
        return self


class ReconstructConfig(_Section):
    """The model; what is left out comes from the preset and from the scene."""

    image_scale: float | None = Field(default=None, ge=0.02, le=1)
    """Train and evaluate on pictures of this relative size."""
    resolution: int | None = Field(default=None, ge=16, le=640)
    """R: the canonical grid has the volume of R³ voxels; the levels of the motion in proportion."""
    rays: int | None = Field(default=None, ge=64, le=1_048_576)
    """Rays per iteration, of both trainings."""
    canonical_iterations: int | None = Field(default=None, ge=1, le=10_000_000)
    """Iterations of the scene at rest; those of its coarse model in proportion."""
    motion_iterations: int | None = Field(default=None, ge=1, le=1_000_000)
    """Iterations per key time of the motion field, over all levels; those of fine-tuning and of movers keep their
    proportion to them."""
    motion: str = "auto"
    """How motion is found: auto (tracked parts or a field, by preset and scene), or by a model that an installed
    package adds."""
    key_times: int | None = Field(default=None, ge=2, le=10_000)
    """Key times of the motion; never more than a camera has pictures."""
    adapt: bool | None = None
    """Decide by the scene how many voxels, key times and levels it needs and whether fine-tuning pays, where not
    given here."""
    seed: int = Field(default=0, ge=0, lt=2**31)
    """Seed of every random draw."""

    @field_validator("motion")
    @classmethod
    def _installed(cls, motion: str) -> str:
        if motion != "auto" and motion not in (there := installed(OWN_MOTION)):
            text = f"{motion!r} is not known, expected {', '.join(('auto', *sorted(there)))}"
            raise ValueError(f"{text}; a package adds one by an entry point of the group {OWN_MOTION}")
        return motion


class BudgetConfig(_Section):
    """What a run may use."""

    memory_gb: float | None = Field(default=None, gt=0)
    """Main memory of a run and of all processes it starts; stages do less at once to keep within it, and
    a run that takes more is ended. Default: what the machine and its cgroups leave, less a tenth."""
    gpu_memory_gb: float | None = Field(default=None, gt=0)
    """Most of a GPU's memory to take: training is fitted to it, rendering and RAFT try again with less at once,
    else the stage ends with a message. Never tried on a GPU."""
    disk_gb: float | None = Field(default=None, gt=0)
    """Most the run folder may hold; checked before each stage and watched while it writes."""
    time_minutes: float | None = Field(default=None, gt=0)
    """Time of one run; a training that is not done by then goes on in the next run, as does what is not begun, the
    film first."""


class EvaluateConfig(_Section):
    """What the result is compared with."""

    holdout_every: int = Field(default=8, ge=2, le=10_000)
    """Every n-th sweep picture is held out of training and used as a test view; photos of one burst count as one."""
    lpips_weights: PathText | None = None
    """Folder of LPIPS weights; or `download`, which gets torchvision's."""
    truth: PathText | None = None
    """Ground truth of a simulated session; default: ground_truth.json beside scene.yaml."""


class SceneConfig(_Section):
    """The whole of scene.yaml."""

    name: str = Field(min_length=1, max_length=200)
    """What the scene is called in reports; 1 to 200 characters."""
    output: PathText | None = Field(default=None, min_length=1)
    """The run folder; default: runs/NAME beside scene.yaml."""
    preset: PresetName = "fast"
    """tiny: sized for two CPU cores; fast: default; reference: the published recipe."""
    capture: CaptureConfig | None = None
    """The raw files; either this or `dataset`."""
    dataset: DatasetConfig | None = None
    """A finished data set; either this or `capture`."""
    calibration: CalibrationConfig = CalibrationConfig()
    """Cameras and clocks."""
    flow: FlowConfig = FlowConfig()
    """Optical flow."""
    reconstruct: ReconstructConfig = ReconstructConfig()
    """The model."""
    budget: BudgetConfig = BudgetConfig()
    """Limits."""
    evaluate: EvaluateConfig = EvaluateConfig()
    """Test views and truth."""

    @property
    def kind(self) -> Kind:
        """sweep: a scene at rest; cameras: no sweep; dynamic: both; dataset: finished data."""
        if self.dataset is not None or self.capture is None:
            return "dataset"
        if self.capture.static is None:
            return "cameras"
        return "dynamic" if self.capture.all_cameras else "sweep"

    @property
    def board(self) -> BoardConfig | None:
        """The calibration board; None where none was filmed."""
        return None if self.capture is None else self.capture.board

    @property
    def rest(self) -> Rest:
        """When the moving clips show the scene as in the sweep; none of a data set."""
        return "none" if self.capture is None else self.capture.rest

    @staticmethod
    def path(scene_dir: Path, value: str) -> Path:
        """A path of the configuration, which is relative to the folder of scene.yaml.

        Accents can be written in two ways that look the same, and macOS stores its own: what is there counts.
        """
        ways = dict.fromkeys((value, *(unicodedata.normalize(form, value) for form in ("NFC", "NFD"))))
        paths = [
            Path(os.path.realpath(scene_dir / Path(way).expanduser()))  # `resolve` fails on a loop of links
            for way in ways
        ]
        return next(filter(os.path.lexists, paths), paths[0])

    @property
    def folder_name(self) -> str:
        """Its name, as a folder's."""
        return safe(self.name, "_.-").strip(".") or "scene"

    def run_dir(self, scene_dir: Path) -> Path:
        """Where the stages' folders lie."""
        return self.path(scene_dir, self.output or f"runs/{self.folder_name}")

    def truth_path(self, scene_dir: Path) -> Path | None:
        """ground_truth.json: the one that is named, else the one beside scene.yaml, else None."""
        if self.evaluate.truth is not None:
            return self.path(scene_dir, self.evaluate.truth)
        beside = scene_dir / "ground_truth.json"
        return beside if beside.is_file() else None
