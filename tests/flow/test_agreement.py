"""Pictures and flow: a moved pattern bears its own motion out, and no other."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, shift

from devrf.flow.agreement import agreement

# u right, v down, pixels, from the current picture to the previous one
HEIGHT, WIDTH, MOVED = (60, 80, (3.0, -1.5))
INSIDE = (slice(8, -8), slice(8, -8))
RNG = np.random.default_rng(0)


def _pictures(noise: float = 1.0, brighter: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """A pattern, and the same where it was before; noise in grey levels."""
    rng = np.random.default_rng(1)
    pattern = gaussian_filter(rng.normal(size=(HEIGHT, WIDTH, 3)), (2, 2, 0))
    pattern = 128 + 40 * pattern / pattern.std()
    before = shift(pattern, (MOVED[1], MOVED[0], 0), order=3, mode="nearest")

    def taken(light: np.ndarray) -> np.ndarray:
        return np.rint(light + rng.normal(0, noise, light.shape)).clip(0, 255).astype(np.uint8)

    return taken(pattern * brighter), taken(before)


def _flow(u: float, v: float) -> np.ndarray:
    return np.broadcast_to(np.array([u, v], np.float32), (HEIGHT, WIDTH, 2)).copy()


VALID = np.ones((HEIGHT, WIDTH), bool)


@pytest.mark.parametrize("brighter", [1.0, 1.05])
def test_the_right_flow_is_believed(brighter: float) -> None:
    found = agreement(*_pictures(brighter=brighter), _flow(*MOVED), VALID)
    assert found.weight[INSIDE].min() > 0.8
    # the border is not known
    assert found.asked > 0.9 * VALID.sum() and found.contradicted < 0.1 * found.asked


@pytest.mark.parametrize(
    "wrong",
    [_flow(-MOVED[0], -MOVED[1]), _flow(0, 0), RNG.normal(0, 4, (HEIGHT, WIDTH, 2)).astype(np.float32)],
    ids=["reversed", "nothing", "noise"],
)
def test_a_wrong_flow_is_contradicted(wrong: np.ndarray) -> None:
    found = agreement(*_pictures(), wrong, VALID)
    assert (found.weight[INSIDE] == 0).mean() > 0.98
    assert found.contradicted > 0.95 * found.asked > 0.9 * VALID.sum()


def test_half_a_picture_may_be_wrong() -> None:
    flow = _flow(*MOVED)
    flow[:, : WIDTH // 2] *= -1
    weight = agreement(*_pictures(), flow, VALID).weight
    assert (weight[8:-8, 8 : WIDTH // 2 - 4] == 0).mean() > 0.98
    assert weight[8:-8, WIDTH // 2 + 4 : -8].min() > 0.8


def test_what_stands_still_is_not_asked_unless_flow_moves_it() -> None:
    now, _ = _pictures()
    again = (now + np.random.default_rng(2).normal(0, 1, now.shape)).clip(0, 255).astype(np.uint8)
    found = agreement(now, again, _flow(0, 0), VALID)
    assert found.asked == 0 and np.median(found.weight) > 0.9
    assert agreement(now, again, _flow(2, 0), VALID).contradicted > 0.98 * VALID.sum()


def test_a_plain_picture_tells_nothing() -> None:
    rng = np.random.default_rng(3)
    now, then = ((128 + rng.normal(0, 2, (HEIGHT, WIDTH, 3))).round().astype(np.uint8) for _ in range(2))
    found = agreement(now, then, _flow(*MOVED), VALID)
    assert found.asked < 0.02 * VALID.sum() and np.median(found.weight) > 0


def test_where_there_is_no_texture_the_pair_answers() -> None:
    now, then = (picture.copy() for picture in _pictures())
    now[:, : WIDTH // 2], then[:, : WIDTH // 2] = 128, 128
    plain = (slice(None), slice(0, WIDTH // 2 - 8))
    assert agreement(now, then, _flow(*MOVED), VALID).weight[plain].min() > 0.5
    assert agreement(now, then, _flow(-MOVED[0], -MOVED[1]), VALID).weight[plain].max() == 0


def test_what_is_hidden_says_nothing_about_vectors_beside_it() -> None:
    now, then = (picture.copy() for picture in _pictures())
    rows, columns = slice(20, 34), slice(24, 38)
    now[rows, columns] = np.random.default_rng(4).integers(0, 255, (14, 14, 3))
    valid = VALID.copy()
    valid[rows, columns] = False
    weight = agreement(now, then, _flow(*MOVED), valid).weight
    assert min(weight[18, 24:38].min(), weight[20:34, 39].min()) > 0.6
    # not left out, it condemns them
    assert agreement(now, then, _flow(*MOVED), VALID).weight[20:34, 39].min() == 0
