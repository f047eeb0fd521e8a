"""The axes: what gets worse, in which steps from hardly to hopelessly, and how the damage gets in."""

from dataclasses import dataclass

from devrf.lab.bench.stability.damage import between, configuration, raw_files
from devrf.lab.bench.stability.damage.intact import Damaging
from devrf.lab.bench.stability.damage.simulated import again, larger, narrower
from devrf.lab.simulate.scenes.session_options import SessionOptions


@dataclass(frozen=True)
class Axis:
    """One way to spoil a scene.

    Attributes:
        group: What it is about: a name for all axes of a kind.
        what: What gets worse.
        unit: What severities count.
        severities: From hardly any to hopeless.
        damaging: What does it.
        films_anew: Whether its test views show something else than the undisturbed ones, so that their own scene at
            rest is what a result has to be better than.
    """

    group: str
    what: str
    unit: str
    severities: tuple[float, ...]
    damaging: Damaging
    films_anew: bool = False

    def some(self, count: int | None) -> tuple[float, ...]:
        """So many severities, evenly chosen, the worst among them; None: all."""
        whole = len(self.severities)
        n = min(count or whole, whole)
        return tuple(self.severities[(k + 1) * whole // n - 1] for k in range(n))


def _paler(was: SessionOptions, percent: float) -> dict[str, float]:
    return {"texture_contrast": was.texture_contrast * (1 - percent / 100)}


def _option(name: str, units: int, sweep_stays: bool = False, cameras_stay: bool = False) -> Damaging:
    """The session simulated again with another option, of which the severity counts so many parts."""
    return again(
        lambda was, severity: {name: severity / units}, sweep_stays=sweep_stays, cameras_stay=cameras_stay
    )


def _change(kind: str, units: int) -> Damaging:
    """Another object in front of the cameras, one that changes; `units` of severity are its usual amount."""
    return again(lambda was, n: {"motion_scale": n / units, "strip_m": 0.0, "change": kind}, "changing")


# fmt: off
AXES = {
    "cameras": Axis("rig", "training cameras", "cameras left out", (1.0, 2.0, 3.0),
                    configuration.fewer_cameras),
    "spread": Axis("rig", "angle between the training cameras, which draw together at one end", "% narrower",
                   (30.0, 50.0, 75.0, 95.0), narrower),
    "pose_noise": Axis("rig", "training cameras turned", "degrees", (0.25, 1.0, 4.0, 16.0),
                       between.turned_cameras),
    "focal_error": Axis("rig", "focal lengths of training cameras too long", "%", (1.0, 4.0, 16.0, 64.0),
                        between.wrong_focal_lengths),
    "sweep_pictures": Axis("sweep", "pictures of the sweep", "only every n-th", (2.0, 3.0, 4.0, 6.0),
                           raw_files.fewer_sweep_pictures),
    "sweep_coverage": Axis("sweep", "path of the sweep, which ends too early", "% of it missing",
                           (20.0, 40.0, 60.0, 80.0), raw_files.partial_sweep),
    "sweep_blur": Axis("sweep", "motion blur of the sweep", "% of the picture's width", (0.5, 1.0, 2.0, 4.0),
                       raw_files.blurred_sweep),
    "sweep_motion": Axis("sweep", "object moves while the sweep is taken", "% of its motion",
                         (10.0, 30.0, 60.0, 100.0), _option("sweep_motion", 100, cameras_stay=True)),
    "time_offset": Axis("clocks", "one camera's clock", "frames late", (0.5, 1.0, 2.0, 4.0),
                        between.late_clock),
    "clock_drift": Axis("clocks", "one camera's clock, right at its first frame", "frames late at its last",
                        (0.5, 1.0, 2.0, 4.0), between.drifting_clock),
    "dropped_frames": Axis("clocks", "one camera's frames", "% lost", (20.0, 40.0, 60.0, 80.0),
                           raw_files.dropped_frames),
    "frame_rate": Axis("clocks", "frame rate of training cameras against the motion", "only every n-th",
                       (2.0, 3.0, 4.0, 6.0), raw_files.lower_frame_rate),
    "deformation": Axis("subject", "size of the deformation", "times the session's", (1.5, 2.0, 2.5, 3.0),
                        larger, films_anew=True),
    "appearing": Axis("subject", "a ball that is not there at rest", "cm radius", (3.0, 7.0, 15.0, 30.0),
                      _change("appear", 20), films_anew=True),
    "parting": Axis("subject", "a block that splits", "cm that each half moves", (3.0, 7.0, 15.0, 30.0),
                    _change("part", 15), films_anew=True),
    "tumbling": Axis("subject", "a block that turns over", "degrees", (20.0, 45.0, 90.0, 180.0),
                     _change("tumble", 90), films_anew=True),
    "thin": Axis("subject", "the sheet cut into strips, with gaps as wide", "strips per metre",
                 (5.0, 10.0, 20.0, 50.0), again(lambda was, n: {"strip_m": 0.5 / n}), films_anew=True),
    "gloss": Axis("subject", "the object mirrors the room", "% of the light", (10.0, 30.0, 60.0, 100.0),
                  _option("gloss", 100), films_anew=True),
    "clear": Axis("subject", "the object lets light through", "% of the light", (10.0, 30.0, 60.0, 90.0),
                  _option("clear", 100), films_anew=True),
    "texture": Axis("surroundings", "texture of the room and the object", "% less contrast",
                    (50.0, 75.0, 90.0, 97.0), again(_paler), films_anew=True),
    "moving_light": Axis("surroundings", "the lamp moves while the object does, and with it all shadows", "m",
                         (0.3, 0.7, 1.4, 2.8), _option("lamp_travel_m", 1, sweep_stays=True),
                         films_anew=True),
    "moving_background": Axis("surroundings", "two boxes behind the object move too", "m",
                              (0.1, 0.3, 0.6, 1.2), _option("background_motion_m", 1, sweep_stays=True),
                              films_anew=True),
    "exposure_drift": Axis("surroundings", "exposure of the training cameras over their clips", "stops",
                           (0.25, 0.5, 1.0, 2.0), raw_files.drifting_exposure),
    "white_drift": Axis("surroundings", "white balance of the training cameras over their clips",
                        "stops of red, and of blue the other way", (0.1, 0.25, 0.5, 1.0),
                        raw_files.drifting_white_balance),
    "flow_wrong": Axis("flow", "pairs whose flow is reversed", "%", (10.0, 30.0, 60.0, 100.0),
                       between.reversed_flow),
    "flow_zero": Axis("flow", "pairs whose flow says that nothing moves", "%", (10.0, 30.0, 60.0, 100.0),
                      between.zeroed_flow),
    "flow_noise": Axis("flow", "error of the flow", "% of the picture's width", (0.5, 2.0, 5.0, 15.0),
                       between.noisy_flow),
    "box_size": Axis("training", "sides of the box", "% too short", (10.0, 30.0, 50.0, 70.0),
                     between.small_box),
    "matte_holes": Axis("training", "holes in mattes", "% of the subject", (2.0, 10.0, 30.0, 60.0),
                        between.mattes_with_holes),
    "learning_rate": Axis("training", "learning rates", "times the preset's", (3.0, 10.0, 30.0, 100.0),
                          configuration.learning_rate),
    "seeds": Axis("training", "nothing but the seed", "another seed", (1.0, 2.0, 3.0),
                  configuration.other_seed),
}
# fmt: on
GROUPS = tuple(dict.fromkeys(axis.group for axis in AXES.values()))


def axes_of(names: list[str]) -> list[str]:
    """Axes out of names of axes and of groups, each once."""
    return list(dict.fromkeys(axis for name in names for axis in AXES if name in (axis, AXES[axis].group)))
