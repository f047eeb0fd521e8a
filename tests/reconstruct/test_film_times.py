"""Times that are asked for: shares of the clip, or seconds."""

from tests.refused import refused

from devrf.capture.system.errors import InputError
from devrf.reconstruct.film.times import parse_time


def test_times_are_shares_or_seconds() -> None:
    assert parse_time("0.25", "--time", 1.0, 3.0) == 0.25
    assert parse_time(" 1.5s", "--time", 1.0, 3.0) == 0.25
    for text in ("-0.1", "0.5s", "3.1s", "1.01"):
        with refused("option-out-of-range", f"--time {text}", "1.000s", "3.000s", kind=InputError):
            parse_time(text, "--time", 1.0, 3.0)
    for text in ("nan", "s", "soon"):
        with refused("option-malformed", f"--time {text}", kind=InputError):
            parse_time(text, "--time", 1.0, 3.0)
