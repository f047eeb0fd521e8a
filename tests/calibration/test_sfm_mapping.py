"""Which of the mappers' models is kept."""

import pytest

from devrf.calibration.sweep.sfm_budget import Deadline
from devrf.calibration.sweep.sfm_mapping import Mapping


class Mapped:
    """A model, as far as the choice between mappers looks at it."""

    def __init__(self, pictures, error, torn):
        self.pictures, self.error, self.torn = pictures, error, torn

    def num_reg_images(self):
        return self.pictures

    def num_points3D(self):
        return 1000

    def compute_mean_reprojection_error(self):
        return self.error


@pytest.mark.parametrize(
    ("first", "second", "both", "tried", "kept"),
    [
        (Mapped(80, 0.5, 3), Mapped(80, 0.6, 0), False, True, "global"),  # torn: the other is tried, and kept
        (Mapped(80, 0.5, 3), Mapped(80, 0.4, 5), False, True, "incremental"),
        (Mapped(80, 0.5, 0), Mapped(80, 0.4, 0), False, False, "incremental"),  # whole: no other is tried
        (Mapped(80, 0.5, 0), Mapped(80, 0.4, 0), True, True, "global"),  # unless both are asked for
        (Mapped(80, 0.5, 1), Mapped(60, 0.4, 0), False, True, "incremental"),  # pictures count first
    ],
)
def test_a_torn_model_is_mapped_by_another_mapper_too(tmp_path, first, second, both, tried, kept):
    models = {"incremental": first, "global": second}
    mapping = Mapping(
        lambda folder, rung, left: [models[rung["mapper"]]],
        lambda model: model.torn,
        tmp_path,
        80,
        Deadline(None),
        lambda share, text: None,
    )
    ladder = [{"name": name, "mapper": name, "accept": 0.8} for name in models]
    mapping.climb(ladder)
    other = mapping.other_mapper(both, ladder)
    assert bool(other) == tried
    mapping.climb(other)
    assert mapping.name == kept and mapping.best is models[kept]
    assert [attempt["torn"] for attempt in mapping.attempts] == [m.torn for m in (first, second)][: 1 + tried]


def test_a_model_of_a_second_try_is_mapped_by_another_mapper_too(tmp_path):
    models = {"incremental": [], "laxer": [Mapped(12, 0.061, 0)], "global": [Mapped(12, 0.056, 0)]}
    mapping = Mapping(
        lambda folder, rung, left: models[rung["name"]],
        lambda model: model.torn,
        tmp_path,
        12,
        Deadline(None),
        lambda share, text: None,
    )
    mappers = {"incremental": "incremental", "laxer": "incremental", "global": "global"}
    ladder = [{"name": name, "mapper": mapper, "accept": 0.8} for name, mapper in mappers.items()]
    mapping.climb(ladder)
    assert mapping.name == "laxer"
    mapping.climb(mapping.other_mapper(False, ladder))
    assert mapping.name == "global"
