"""Whether errors fall as confidence rises: expected and measured errors of pixels, side by side.

Sparsification (Ilg et al., Uncertainty Estimates and Multi-Hypotheses Networks for Optical Flow, ECCV 2018): leave out
the pixels that are least sure, more and more of them, and look at the error of those left. The oracle leaves out the
most wrong ones; the area between both (AUSE), relative to the error of all, is 0 for perfect ranks.
"""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float

BINS = 10
REMOVED = 20  # shares of pixels that are left out, from none to all but a twentieth
PER_PICTURE = 20_000  # pixels that are kept of a picture
GREY = 255.0


class ErrorCurve:
    """Collects pixels of pictures; errors are roots of squared ones, mean over channels, of the full range."""

    def __init__(self) -> None:
        self._expected: list[np.ndarray] = []
        self._squared: list[np.ndarray] = []

    def add(
        self,
        expected: Float[np.ndarray, "h w"],
        rendered: Float[np.ndarray, "h w 3"],
        true: Float[np.ndarray, "h w 3"],
        where: Bool[np.ndarray, "h w"] | None = None,
    ) -> None:
        """Add a picture, or its pixels `where`; of many, every n-th."""
        squared = ((rendered.astype(np.float64) - true) ** 2).mean(-1)
        kept = slice(None) if where is None else where
        expected, squared = expected[kept].reshape(-1), squared[kept].reshape(-1)
        every = max(1, -(-len(squared) // PER_PICTURE))
        self._expected.append(expected[::every].astype(np.float64))
        self._squared.append(squared[::every].copy())  # a view would keep the whole picture

    def summary(self, absent: str) -> dict[str, Any]:
        """The curve, in grey levels.

        Args:
            absent: Why there may be no pixel; the result then is only that.
        Returns:
            `pixels`; `expected_rms`, `measured_rms`; `spearman`; `ause` and `ause_random`; `bins`, the surest first, of
            `share`, `expected_rms` and `measured_rms`; `sparsification`: `removed`, `by_confidence`, `oracle`.
        """
        from scipy.stats import rankdata

        if not sum(map(len, self._squared)):
            return {"pixels": 0, "why": absent}
        expected, squared = np.concatenate(self._expected), np.concatenate(self._squared)
        order = np.argsort(expected, kind="stable")
        varies = np.ptp(expected) > 0 and np.ptp(squared) > 0
        ranks = float(np.corrcoef(rankdata(expected), rankdata(squared))[0, 1]) if varies else 0.0
        by_confidence, oracle = _left(squared[order]), _left(np.sort(squared))
        rms = _rms(squared)
        scale = max(rms, 1 / GREY)
        return {
            "pixels": len(squared),
            "expected_rms": GREY * _rms(expected**2),
            "measured_rms": GREY * rms,
            "spearman": ranks,
            "ause": float(np.mean(by_confidence - oracle)) / scale,
            "ause_random": float(np.mean(rms - oracle)) / scale,
            "bins": [
                {
                    "share": len(part) / len(squared),
                    "expected_rms": GREY * _rms(expected[part] ** 2),
                    "measured_rms": GREY * _rms(squared[part]),
                }
                for part in np.array_split(order, BINS)
                if len(part)
            ],
            "sparsification": {
                "removed": [n / REMOVED for n in range(REMOVED)],
                "by_confidence": (GREY * by_confidence).tolist(),
                "oracle": (GREY * oracle).tolist(),
            },
        }


def _left(squared: Float[np.ndarray, " n"]) -> Float[np.ndarray, " removed"]:
    """Error of what is left when the last 0, 1, 2, ... twentieths are gone."""
    n = len(squared)
    kept = [max(1, round(n * (REMOVED - k) / REMOVED)) for k in range(REMOVED)]
    return np.sqrt(np.cumsum(squared)[np.array(kept) - 1] / kept)


def _rms(squared: Float[np.ndarray, " n"]) -> float:
    return float(np.sqrt(squared.mean()))
