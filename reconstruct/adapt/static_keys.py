"""Key times at which nothing has changed since the one before: they take its motion and need no training."""

from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor

from devrf.reconstruct.adapt.sizing import Decision
from devrf.reconstruct.rendering.rays import RaySet
from devrf.reconstruct.sampling.moving_pixels import same


def still_keys(
    rays: RaySet, tau: Float[Tensor, " F"], order: Sequence[int], rest_key: int | None
) -> tuple[set[int], Decision | None]:
    """Those of `order` at which every camera sees what it saw at the last key time that is trained.

    Args:
        rays: The training pictures.
        tau: Their times, in key spacings.
        order: Key times as they are visited.
        rest_key: The one that is known to be at rest, visited before all.
    """
    still: set[int] = set()
    at_rest = before = None if rest_key is None else _nearest(rays, tau, rest_key)
    for key in order:
        if rest_key is not None and key == rest_key - 1:  # back from the rest
            before = at_rest
        now = _nearest(rays, tau, key)
        if before is not None and all(same(rays, before[name], now[name]) for name in now):
            still.add(key)
        else:
            before = now
    if not still:
        return still, None
    trained = len(order) - len(still)
    reason = "at the others no camera sees a change" if trained else "nothing moves: no camera sees a change"
    return still, Decision("key times to train", f"{trained or 'none'}", f"{len(order)}", reason)


def still_beyond_rest(rays: RaySet, tau: Float[Tensor, " F"], keys: int, rest_key: int | None) -> set[int]:
    """Key times between the rest and the nearer end at which nobody sees a change: a rest that lasts.

    They are not trained: every step would only make them worse, which looks as if training ran away. Cameras that film
    nothing else there tell nothing. Other arguments as `still_keys`'.
    """
    still: set[int] = set()
    if rest_key is None:
        return still
    at_rest = _nearest(rays, tau, rest_key)
    for key in range(rest_key - 1, -1, -1) if 2 * rest_key < keys else range(rest_key + 1, keys):
        now = _nearest(rays, tau, key)
        if any(n != at_rest[name] and not same(rays, at_rest[name], n) for name, n in now.items()):
            break
        still.add(key)
    return still


def _nearest(rays: RaySet, tau: Tensor, key: int) -> dict[str, int]:
    """Each camera's picture nearest to a key time."""
    away = (tau - key).abs().tolist()
    nearest: dict[str, int] = {}
    for n, frame in enumerate(rays.frames):
        if frame.camera_name not in nearest or away[n] < away[nearest[frame.camera_name]]:
            nearest[frame.camera_name] = n
    return nearest
