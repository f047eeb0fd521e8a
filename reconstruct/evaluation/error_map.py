"""Pictures of errors: where a rendered picture differs from the true one."""

import numpy as np
from jaxtyping import Float, Float32

ERROR_GAIN = 4  # an error of a quarter of the range is the brightest colour
# matplotlib's colour map "inferno": every 15th of its 256 colours
INFERNO = (
    "0000040a07221e0c45380962510e6c69166e801f6c982766"
    "b0315bc63d4dd94d3de9612bf47918fa9407fcb014f8cd37f2ea69fcffa4"
)


def error_map(
    rendered: Float[np.ndarray, "height width 3"], true: Float[np.ndarray, "height width 3"]
) -> Float32[np.ndarray, "height width 3"]:
    """The largest difference over channels, from black over red to yellow, RGB in [0, 1]."""
    return inferno(ERROR_GAIN * np.abs(rendered - true).max(axis=-1))


def inferno(share: Float[np.ndarray, "height width"]) -> Float32[np.ndarray, "height width 3"]:
    """Shares as colours, 0 black, over red to yellow, 1 and more the brightest; RGB in [0, 1]."""
    table = np.frombuffer(bytes.fromhex(INFERNO), np.uint8).reshape(-1, 3) / 255
    at = np.linspace(0, 1, len(table))
    return np.stack([np.interp(share, at, channel) for channel in table.T], axis=-1).astype(np.float32)
