"""The axes: what gets worse, in which steps from hardly to hopelessly, and how the damage gets in."""

from dataclasses import dataclass

from devrf.pipelines.bench.stability import damage
from devrf.pipelines.bench.stability.damage import Damaging


@dataclass(frozen=True)
class Axis:
    """One way to spoil a scene.

    Attributes:
        what: What gets worse.
        unit: What severities count.
        severities: From hardly any to hopeless.
        damaging: What does it.
    """

    what: str
    unit: str
    severities: tuple[float, ...]
    damaging: Damaging

    def some(self, count: int | None) -> tuple[float, ...]:
        """So many severities, evenly chosen, the worst among them; None: all."""
        whole = len(self.severities)
        n = min(count or whole, whole)
        return tuple(self.severities[(k + 1) * whole // n - 1] for k in range(n))


AXES = {
    "cameras": Axis("training cameras", "cameras left out", (1.0, 2.0, 3.0), damage.fewer_cameras),
    "sweep_pictures": Axis(
        "pictures of the sweep", "only every n-th", (2.0, 3.0, 4.0, 6.0), damage.fewer_sweep_pictures
    ),
    "sweep_blur": Axis(
        "motion blur of the sweep", "% of the picture's width", (0.5, 1.0, 2.0, 4.0), damage.blurred_sweep
    ),
    "pose_noise": Axis("training cameras turned", "degrees", (0.25, 1.0, 4.0, 16.0), damage.turned_cameras),
    "focal_error": Axis(
        "focal lengths of training cameras too long", "%", (1.0, 4.0, 16.0, 64.0), damage.wrong_focal_lengths
    ),
    "time_offset": Axis("one camera's clock", "frames late", (0.5, 1.0, 2.0, 4.0), damage.late_clock),
    "flow_wrong": Axis("pairs whose flow is reversed", "%", (10.0, 30.0, 60.0, 100.0), damage.reversed_flow),
    "box_size": Axis("sides of the box", "% too short", (10.0, 30.0, 50.0, 70.0), damage.small_box),
    "learning_rate": Axis(
        "learning rates", "times the preset's", (3.0, 10.0, 30.0, 100.0), damage.learning_rate
    ),
    "seeds": Axis("nothing but the seed", "another seed", (1.0, 2.0, 3.0), damage.other_seed),
}
