"""Options of training: a factor on the learning rates reaches every one of them."""

import pytest

from devrf.reconstruct.options import preset


@pytest.mark.parametrize("name", ["tiny", "fast", "reference"])
def test_learning_rates_are_relative_to_the_presets(name: str) -> None:
    usual, fast = preset(name), preset(name, learning_rate=10.0)
    assert fast.canonical.learning_rate == fast.motion.learning_rate == 10.0
    assert preset(name, learning_rate=1.0) == usual
