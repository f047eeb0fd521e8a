"""Whether errors fall as confidence rises: expected and measured errors of pixels of test pictures, side by side."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float64

BINS = 10
PER_PICTURE = 20_000  # pixels that are kept of a picture
GREY = 255.0


def errors(
    expected: Float[np.ndarray, "h w"],
    rendered: Float[np.ndarray, "h w 3"],
    true: Float[np.ndarray, "h w 3"],
    where: Bool[np.ndarray, "h w"] | None = None,
) -> Float64[np.ndarray, "2 n"]:
    """Expected and measured squared errors, of the full range, of a picture's pixels `where`; of many, every n-th."""
    pairs = np.stack([expected.astype(np.float64) ** 2, ((rendered.astype(np.float64) - true) ** 2).mean(-1)])
    pairs = pairs.reshape(2, -1) if where is None else pairs[:, where]
    return pairs[
        :, :: max(1, -(-pairs.shape[1] // PER_PICTURE))
    ].copy()  # a view would keep the whole picture


def curve(pictures: Sequence[Float64[np.ndarray, "2 _"]], absent: str) -> dict[str, Any]:
    """The errors of pictures in grey levels, roots of means.

    Args:
        pictures: What `errors` gave of each.
        absent: Why there may be no pixel; the result then is only that.
    Returns:
        `pixels`; `expected_rms`, `measured_rms`; `spearman`, their rank correlation; `bins`, the surest tenth of
        the pixels first, of `share`, `expected_rms` and `measured_rms`.
    """
    from scipy.stats import spearmanr

    pairs = np.concatenate([np.zeros((2, 0)), *pictures], axis=1)
    n = pairs.shape[1]
    if not n:
        return {"pixels": 0, "why": absent}
    varies = bool((np.ptp(pairs, axis=1) > 0).all())
    parts = np.array_split(pairs[:, np.argsort(pairs[0], kind="stable")], BINS, axis=1)
    return {
        "pixels": n,
        **_rms(pairs),
        "spearman": float(np.asarray(spearmanr(*pairs))[0]) if varies else 0.0,
        "bins": [{"share": part.shape[1] / n, **_rms(part)} for part in parts if part.size],
    }


def _rms(pairs: Float64[np.ndarray, "2 n"]) -> dict[str, float]:
    expected, measured = (GREY * np.sqrt(pairs.mean(axis=1))).tolist()
    return {"expected_rms": expected, "measured_rms": measured}
